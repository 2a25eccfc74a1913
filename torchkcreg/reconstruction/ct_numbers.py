"""CT numbers."""

from __future__ import annotations

from torch import Tensor


def hounsfield(attenuation: Tensor, water: float) -> Tensor:
    """CT numbers in HU, ``1000 (mu - mu_water) / mu_water``, of attenuation in 1/mm.

    >>> import torch
    >>> hounsfield(torch.tensor([0.0, 0.02, 0.03]), 0.02).round().tolist()
    [-1000.0, 0.0, 500.0]
    """
    if not water > 0:
        raise ValueError(f"water must be a positive attenuation in 1/mm, got {water}")
    return 1000 * (attenuation - water) / water

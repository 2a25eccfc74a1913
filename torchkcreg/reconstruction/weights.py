"""How much each measured line integral counts."""

from __future__ import annotations

import torch
from torch import Tensor


def statistical_weights(
    primary: Tensor,
    *,
    scatter: Tensor | float = 0.0,
    mask: Tensor | None = None,
    noise: float = 0.0,
    sensitivity: Tensor | float = 1.0,
) -> Tensor:
    """One over the variance of line integrals, relative to the open beam's: 1 in air, exp(-l) behind something.

    A count of ``primary + scatter`` has its own size as variance (Poisson), and the line integral ``-ln primary`` that
    over ``primary^2``: ``w = primary^2 / (primary + scatter + noise)``.

    Args:
        primary: intensity without scatter, in units of the open beam, any shape.
        scatter: what was taken away before the logarithm, same unit.
        mask: 0 where a pixel holds no measurement.
        noise: variance of the detector's own noise, in the square of counts over the open beam's counts.
        sensitivity: derivative of the measured line integral to the one that is reconstructed, where these differ
            (beam hardening); the weights take its square.

    >>> statistical_weights(torch.tensor([1.0, 0.5])).tolist()
    [1.0, 0.5]
    """
    primary = primary.clamp_min(0)
    total = (primary + scatter + noise).clamp_min(torch.finfo(primary.dtype).tiny)
    weights = primary * (primary / total) * torch.as_tensor(sensitivity).to(primary) ** 2
    return weights if mask is None else weights * mask

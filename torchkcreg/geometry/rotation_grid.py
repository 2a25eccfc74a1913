"""Rotations spread evenly over all orientations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_PHI = math.sqrt(2.0)
_PSI = 1.533751168755204288118041  # the real root of x^4 = x + 4 above one


def rotation_grid(number: int, device: torch.device | str = "cpu") -> Tensor:
    """Rotations (K, 3, 3), float64, spread evenly over SO(3): super-Fibonacci spirals (Alexa, CVPR 2022).

    The nearest one to any rotation is about `230 / K^(1/3)` degrees away at most: 14 degrees for 4608.

    Args:
        number: Number K of rotations.
        device: Device of the result.

    >>> grid = rotation_grid(1000)
    >>> bool(torch.allclose(grid @ grid.mT, torch.eye(3).double().expand(1000, 3, 3)))
    True
    >>> grid.mean(0).abs().max() < 0.01
    tensor(True)
    """
    if number < 1:
        raise ValueError(f"number must be positive, got {number}")
    i = torch.arange(number, dtype=torch.float64, device=device) + 0.5
    inner, outer = (i / number).sqrt(), (1 - i / number).sqrt()
    a, b = 2 * math.pi * i / _PHI, 2 * math.pi * i / _PSI
    x, y, z, w = inner * a.sin(), inner * a.cos(), outer * b.sin(), outer * b.cos()
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

"""Principal axes of points."""

from __future__ import annotations

import torch
from torch import Tensor


def principal_axes(points: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (3,) of points (N, 3), and unit vectors (3, 3), one a row, from the least variance to the largest.

    Signs are as they come: an axis may point either way.
    """
    center = points.mean(0)
    return center, torch.linalg.eigh((points - center).mT @ (points - center)).eigenvectors.mT

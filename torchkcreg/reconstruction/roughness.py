"""Quadratic roughness of volumes: squared differences between neighbouring voxels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def quadratic_roughness(volume: Tensor, *, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> Tensor:
    """``R = 1/2 sum k (x_i - x_j)^2`` over pairs of face neighbours of a volume (D, H, W); a scalar.

    The weight k of a direction is ``(h / d)^2`` with d the voxel's size (x, y, z) along it and h the geometric mean, 1
    for cubes.

    >>> quadratic_roughness(torch.tensor([[[0.0, 1.0, 3.0]]])).item()
    2.5
    """
    total = volume.new_zeros((), dtype=torch.float64)
    for dim, weight in _directions(spacing):
        difference = volume.diff(dim=dim)
        total = total + weight / 2 * difference.square().sum(dtype=torch.float64)
    return total


def roughness_gradient(volume: Tensor, *, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> Tensor:
    """The derivative of `quadratic_roughness`, (D, H, W)."""
    gradient = torch.zeros_like(volume)
    for dim, weight in _directions(spacing):
        size = volume.shape[dim]
        difference = volume.diff(dim=dim)
        gradient.narrow(dim, 1, size - 1).add_(difference, alpha=weight)
        gradient.narrow(dim, 0, size - 1).sub_(difference, alpha=weight)
    return gradient


def roughness_curvature(volume: Tensor, *, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> Tensor:
    """Curvatures (D, H, W) of separable parabolas above `quadratic_roughness` (De Pierro 1995): ``2 sum_j k``."""
    curvature = torch.zeros_like(volume)
    for dim, weight in _directions(spacing):
        size = volume.shape[dim]
        curvature.narrow(dim, 1, size - 1).add_(2 * weight)
        curvature.narrow(dim, 0, size - 1).add_(2 * weight)
    return curvature


def _directions(spacing: Sequence[float]) -> list[tuple[int, float]]:
    """Dimension and weight of the neighbours along z, y and x."""
    x, y, z = (float(d) for d in spacing)
    mean = (x * y * z) ** (1 / 3)
    return [(-3, (mean / z) ** 2), (-2, (mean / y) ** 2), (-1, (mean / x) ** 2)]

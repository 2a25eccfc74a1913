"""Quadratic roughness of volumes: squared differences between neighbouring voxels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

Weights = Sequence[tuple[int, float | Tensor]]  # dimension of neighbours, and the weight of their difference


class Roughness(Protocol):
    """A convex measure of how rough a volume is, of the shape that a `System` projects."""

    def value(self, volume: Tensor) -> Tensor:
        """The roughness, a scalar."""

    def gradient(self, volume: Tensor) -> Tensor:
        """Its derivative, of the volume's shape."""

    def curvature(self, volume: Tensor) -> Tensor:
        """Curvatures, of the volume's shape, of separable parabolas above it."""


class VoxelRoughness:
    """`quadratic_roughness` of volumes of one spacing, as a `Roughness`.

    Args:
        spacing: of the voxels (x, y, z), mm.
    """

    def __init__(self, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
        self.weights = _directions(spacing)

    def value(self, volume: Tensor) -> Tensor:
        """The roughness, a scalar."""
        return pair_roughness(volume, self.weights)

    def gradient(self, volume: Tensor) -> Tensor:
        """Its derivative, (D, H, W)."""
        return pair_gradient(volume, self.weights)

    def curvature(self, volume: Tensor) -> Tensor:
        """Curvatures (D, H, W) of separable parabolas above it (De Pierro 1995)."""
        return pair_curvature(volume, self.weights)


def quadratic_roughness(volume: Tensor, *, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> Tensor:
    """``R = 1/2 sum k (x_i - x_j)^2`` over pairs of face neighbours of a volume (D, H, W); a scalar.

    The weight k of a direction is ``(h / d)^2`` with d the voxel's size (x, y, z) along it and h the geometric mean, 1
    for cubes.

    >>> quadratic_roughness(torch.tensor([[[0.0, 1.0, 3.0]]])).item()
    2.5
    """
    return pair_roughness(volume, _directions(spacing))


def pair_roughness(volume: Tensor, weights: Weights) -> Tensor:
    """``1/2 sum k (x_i - x_j)^2``, a scalar, with weights k of each dimension's pairs of neighbours."""
    total = volume.new_zeros((), dtype=torch.float64)
    for dim, weight in weights:
        total = total + 0.5 * (volume.diff(dim=dim).square() * weight).sum(dtype=torch.float64)
    return total


def pair_gradient(volume: Tensor, weights: Weights) -> Tensor:
    """The derivative of `pair_roughness`, of the volume's shape."""
    gradient = torch.zeros_like(volume)
    for dim, weight in weights:
        size = volume.shape[dim]
        pull = volume.diff(dim=dim).mul_(weight)
        gradient.narrow(dim, 1, size - 1).add_(pull)
        gradient.narrow(dim, 0, size - 1).sub_(pull)
    return gradient


def pair_curvature(volume: Tensor, weights: Weights) -> Tensor:
    """Curvatures of separable parabolas above `pair_roughness` (De Pierro 1995): ``2 sum_j k``."""
    curvature = torch.zeros_like(volume)
    for dim, weight in weights:
        size = volume.shape[dim]
        curvature.narrow(dim, 1, size - 1).add_(2 * weight)
        curvature.narrow(dim, 0, size - 1).add_(2 * weight)
    return curvature


def _directions(spacing: Sequence[float]) -> list[tuple[int, float]]:
    """Dimension and weight of the neighbours along z, y and x."""
    x, y, z = (float(d) for d in spacing)
    mean = (x * y * z) ** (1 / 3)
    return [(-3, (mean / z) ** 2), (-2, (mean / y) ** 2), (-1, (mean / x) ** 2)]

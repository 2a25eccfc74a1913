"""What an iterative reconstruction knows of a scanner: line integrals of a volume, and their adjoint, by views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.projector import backproject, project_volume

Weights = Sequence[tuple[int, float | Tensor]]  # dimension of neighbours, and the weight of their difference
BLOCK_VIEWS = 20  # projected together


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


class System(Protocol):
    """A linear projector by views. Bring your own, or take `VoxelSystem`.

    Attributes:
        volume_shape: of the volumes: (D, H, W), or what else the projector knows, such as (N,) of two levels of voxels.
        num_views: V.
        sources: label of each view's focal spot, or None; ordered subsets then hold all of them evenly.
    """

    @property
    def volume_shape(self) -> tuple[int, ...]:
        """(D, H, W)."""

    @property
    def num_views(self) -> int:
        """V."""

    @property
    def sources(self) -> Sequence[str] | None:
        """Labels of the views' focal spots."""

    def project(self, volume: Tensor, views: Sequence[int]) -> Tensor:
        """Line integrals (len(views), rows, cols) of a volume (D, H, W)."""

    def backproject(self, images: Tensor, views: Sequence[int]) -> Tensor:
        """The adjoint: a volume (D, H, W) from images (len(views), rows, cols)."""


def projected(system: System, volume: Tensor) -> Tensor:
    """Line integrals (V, rows, cols) of a volume in all views, some at a time."""
    views = range(system.num_views)
    blocks = [views[start : start + BLOCK_VIEWS] for start in range(0, len(views), BLOCK_VIEWS)]
    return torch.cat([system.project(volume, block) for block in blocks])


class VoxelSystem(nn.Module):
    """The library's voxel projector in the views of a geometry.

    Args:
        geometry: the views.
        grid: the voxels.
        backend: "auto", "cpp" or "torch".

    >>> import torch
    >>> from torchkcreg.geometry import VolumeGrid, circular_geometry
    >>> geometry = circular_geometry([0, 90], sad=404, sdd=538, det_shape=(5, 5), pixel_spacing=(2.0, 2.0))
    >>> system = VoxelSystem(geometry, VolumeGrid.centered((20, 20, 20), 1.0))
    >>> round(float(system.project(torch.ones(20, 20, 20), [0])[0, 2, 2]), 3)
    20.0
    """

    def __init__(self, geometry: ConeBeamGeometry, grid: VolumeGrid, *, backend: str = "auto") -> None:
        super().__init__()
        self.geometry, self.grid, self.backend = geometry, grid, backend

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """(D, H, W)."""
        return self.grid.shape

    @property
    def num_views(self) -> int:
        """V."""
        return self.geometry.num_views

    @property
    def sources(self) -> tuple[str, ...] | None:
        """Labels of the views' focal spots."""
        return self.geometry.sources

    def project(self, volume: Tensor, views: Sequence[int]) -> Tensor:
        """Line integrals (len(views), rows, cols) of a volume (D, H, W)."""
        matrices = self.geometry.projection_matrices[list(views)]
        return project_volume(volume, self.grid, matrices, self.geometry.det_shape, backend=self.backend)

    def backproject(self, images: Tensor, views: Sequence[int]) -> Tensor:
        """A volume (D, H, W) from images (len(views), rows, cols)."""
        return backproject(images, self.grid, self.geometry.projection_matrices[list(views)], backend=self.backend)

    def extra_repr(self) -> str:
        """Grid and backend."""
        return f"volume_shape={self.volume_shape}, backend={self.backend!r}"

"""System model of iterative reconstruction: projection of a volume by views, its adjoint, and roughness penalties."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.projector import backproject, project_volume

Weights = Sequence[tuple[int, float | Tensor]]  # dimension of the neighbours, weight of their difference
BLOCK_VIEWS = 20  # projected together


class Roughness(Protocol):
    """Convex roughness penalty of volumes in the shape that a `System` projects."""

    def value(self, volume: Tensor) -> Tensor:
        """The roughness, a scalar."""

    def gradient(self, volume: Tensor) -> Tensor:
        """Derivative of the roughness, of the volume's shape."""

    def curvature(self, volume: Tensor) -> Tensor:
        """Curvatures of separable parabolas that majorise it, of the volume's shape."""


class VoxelRoughness:
    """`quadratic_roughness` of volumes with a given voxel spacing, as a `Roughness`.

    Args:
        spacing: Voxel spacing (x, y, z), mm.
    """

    def __init__(self, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
        self.weights = _directions(spacing)

    def value(self, volume: Tensor) -> Tensor:
        """The roughness, a scalar."""
        return pair_roughness(volume, self.weights)

    def gradient(self, volume: Tensor) -> Tensor:
        """Derivative of the roughness, (D, H, W)."""
        return pair_gradient(volume, self.weights)

    def curvature(self, volume: Tensor) -> Tensor:
        """Curvatures (D, H, W) of separable parabolas that majorise it (De Pierro 1995)."""
        return pair_curvature(volume, self.weights)


def quadratic_roughness(volume: Tensor, *, spacing: Sequence[float] = (1.0, 1.0, 1.0)) -> Tensor:
    """`R = 1/2 sum k (x_i - x_j)^2` over pairs of face neighbours of a volume (D, H, W); a scalar.

    The weight of a direction is `k = (h / d)^2`, with d the voxel size along it and h the geometric mean of the voxel
    sizes (x, y, z); k is 1 for cubes.

    >>> quadratic_roughness(torch.tensor([[[0.0, 1.0, 3.0]]])).item()
    2.5
    """
    return pair_roughness(volume, _directions(spacing))


def pair_roughness(volume: Tensor, weights: Weights) -> Tensor:
    """`1/2 sum k (x_i - x_j)^2`, a scalar, with weights k for each dimension's pairs of neighbours."""
    total = volume.new_zeros((), dtype=torch.float64)
    for dim, weight in weights:
        total = total + 0.5 * (volume.diff(dim=dim).square() * weight).sum(dtype=torch.float64)
    return total


def pair_gradient(volume: Tensor, weights: Weights) -> Tensor:
    """Derivative of `pair_roughness`, of the volume's shape."""
    gradient = torch.zeros_like(volume)
    for dim, weight in weights:
        size = volume.shape[dim]
        pull = volume.diff(dim=dim).mul_(weight)
        gradient.narrow(dim, 1, size - 1).add_(pull)
        gradient.narrow(dim, 0, size - 1).sub_(pull)
    return gradient


def pair_curvature(volume: Tensor, weights: Weights) -> Tensor:
    """Curvatures of separable parabolas that majorise `pair_roughness` (De Pierro 1995): `2 sum_j k`."""
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
    """Linear projector by views. Use `VoxelSystem` or your own.

    Attributes:
        volume_shape: Shape of the volumes: (D, H, W), or another shape such as (N,) for two levels of voxels.
        num_views: Number of views V.
        sources: Label of each view's focal spot, or None. With labels, focal spots are spread evenly over the subsets.
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
        """Adjoint projection: a volume (D, H, W) from images (len(views), rows, cols)."""


def projected(system: System, volume: Tensor) -> Tensor:
    """Line integrals (V, rows, cols) of a volume in all views, computed in blocks of views."""
    views = range(system.num_views)
    blocks = [views[start : start + BLOCK_VIEWS] for start in range(0, len(views), BLOCK_VIEWS)]
    return torch.cat([system.project(volume, block) for block in blocks])


class VoxelSystem(nn.Module):
    """Voxel projector of this library for the views of a geometry.

    Args:
        geometry: The views.
        grid: The voxels.
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
        """Adjoint projection: a volume (D, H, W) from images (len(views), rows, cols)."""
        return backproject(images, self.grid, self.geometry.projection_matrices[list(views)], backend=self.backend)

    def extra_repr(self) -> str:
        """Grid and backend."""
        return f"volume_shape={self.volume_shape}, backend={self.backend!r}"

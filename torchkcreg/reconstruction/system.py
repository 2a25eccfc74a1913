"""What an iterative reconstruction knows of a scanner: line integrals of a volume, and their adjoint, by views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.projector import backproject, project_volume

BLOCK_VIEWS = 20  # projected together


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

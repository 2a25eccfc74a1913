"""A piece of metal in its place in the world: what a reconstruction is told of an implant."""

from __future__ import annotations

from dataclasses import dataclass

import trimesh
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

from .point_cloud import ImplantPointCloud
from .voxelize import voxelize_mesh, voxelize_points


@dataclass(frozen=True)
class KnownComponent:
    """A piece of metal in its place in the world: bent plate, screw.

    Attributes:
        cloud: fine nodes with partial volumes, in world mm.
        material: name of its material.
        mesh: its surface in world mm, where there is one: makes the mask exact.
    """

    cloud: ImplantPointCloud
    material: str
    mesh: trimesh.Trimesh | None = None

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh, material: str, *, pitch: float = 0.25) -> KnownComponent:
        """From a closed surface in world mm.

        >>> ball = KnownComponent.from_mesh(trimesh.creation.icosphere(2, 3.0), "steel", pitch=0.5)
        >>> ball.material, ball.mesh.is_watertight
        ('steel', True)
        """
        return cls(ImplantPointCloud.from_mesh(mesh, pitch), material, mesh)

    def fraction(self, grid: VolumeGrid) -> Tensor:
        """Share of each voxel that it fills, (D, H, W)."""
        if self.mesh is not None:
            return voxelize_mesh(self.mesh, grid)
        return voxelize_points(self.cloud.points, self.cloud.volumes, grid, cell=self.cloud.cell).clamp(0, 1)

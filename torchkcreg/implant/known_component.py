"""Metal objects at known positions in the world, as used by a known-component reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import trimesh
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

from .point_cloud import ImplantPointCloud
from .voxelize import voxelize_mesh, voxelize_points


@dataclass(frozen=True)
class KnownComponent:
    """A metal object (bent plate, screw) at its position in the world.

    Attributes:
        cloud: Fine nodes with partial volumes, in world coordinates, mm.
        material: Name of its material.
        mesh: Its surface in world coordinates, mm, if available; makes the mask exact.
    """

    cloud: ImplantPointCloud
    material: str
    mesh: trimesh.Trimesh | None = None

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh, material: str, *, pitch: float = 0.25) -> KnownComponent:
        """Component from a closed surface in world coordinates, mm.

        >>> ball = KnownComponent.from_mesh(trimesh.creation.icosphere(2, 3.0), "steel", pitch=0.5)
        >>> ball.material, ball.mesh.is_watertight
        ('steel', True)
        """
        return cls(ImplantPointCloud.from_mesh(mesh, pitch), material, mesh)

    def fraction(self, grid: VolumeGrid) -> Tensor:
        """Fraction of each voxel that it fills, (D, H, W)."""
        if self.mesh is not None:
            return voxelize_mesh(self.mesh, grid)
        return voxelize_points(self.cloud.points, self.cloud.volumes, grid, cell=self.cloud.cell).clamp(0, 1)

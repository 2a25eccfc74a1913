"""Implants as point clouds (nodes, volumes, lattice cells) from a mesh or a volume; holes, screws, voxelization."""

from .closed_mesh import closed_mesh, closed_triangles, deformed_surface, volume
from .components import Component
from .holes import Hole, find_holes
from .known_component import KnownComponent
from .partial_volumes import FilledCells, fill_cells
from .point_cloud import ImplantPointCloud, morton_order
from .scanned import scanned_surface
from .screws import Screw, cylinder_cloud, cylinder_mesh
from .voxelize import voxelize_mesh, voxelize_points

__all__ = [
    "Component",
    "FilledCells",
    "Hole",
    "ImplantPointCloud",
    "KnownComponent",
    "Screw",
    "closed_mesh",
    "closed_triangles",
    "cylinder_cloud",
    "cylinder_mesh",
    "deformed_surface",
    "fill_cells",
    "find_holes",
    "morton_order",
    "scanned_surface",
    "volume",
    "voxelize_mesh",
    "voxelize_points",
]

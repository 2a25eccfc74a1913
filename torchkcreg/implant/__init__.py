"""Known components: an implant as a point cloud of nodes, volumes and cells, from a mesh or from a volume; screws."""

from torchkcreg.implant.closed_mesh import closed_mesh, closed_triangles, volume
from torchkcreg.implant.components import Component
from torchkcreg.implant.cylinders import cylinder_cloud, cylinder_mesh
from torchkcreg.implant.deformed import deformed_surface
from torchkcreg.implant.holes import Hole, find_holes
from torchkcreg.implant.morton import morton_order
from torchkcreg.implant.partial_volumes import FilledCells, fill_cells
from torchkcreg.implant.point_cloud import ImplantPointCloud
from torchkcreg.implant.scanned import scanned_surface
from torchkcreg.implant.screws import Screw
from torchkcreg.implant.voxelize import voxelize_mesh, voxelize_points

__all__ = [
    "Component",
    "FilledCells",
    "Hole",
    "ImplantPointCloud",
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

"""Projectors: path length in mm through an implant, for each pixel of each view.

`project_points` draws a point cloud, node by node, with footprints that leave no stripes; `project_mesh` draws a closed
triangle mesh, exactly. `project_volume` integrates a voxel volume along rays, `backproject` is its adjoint, and
`backproject_weighted` what filtered back-projection needs.
"""

from __future__ import annotations

from .footprint import Footprint, cell_footprint
from .mesh import project_mesh
from .point_cloud import PointCloudProjector, project_points
from .voxels import VolumeProjector, backproject, backproject_weighted, project_volume

__all__ = [
    "Footprint",
    "PointCloudProjector",
    "VolumeProjector",
    "backproject",
    "backproject_weighted",
    "cell_footprint",
    "project_mesh",
    "project_points",
    "project_volume",
]

"""Projectors: path length in mm through an implant, for each pixel of each view.

`project_points` splats the nodes of a point cloud with footprints that leave no stripes. `project_mesh` computes exact
pixel averages for a closed triangle mesh. `project_volume` integrates a voxel volume along rays, `backproject` is its
adjoint, and `backproject_weighted` is the weighted back-projection of FDK.
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

"""Projectors: path length in mm through an implant, for each pixel of each view.

`project_points` draws a point cloud, node by node, with footprints that leave no stripes.
"""

from __future__ import annotations

from .footprint import Footprint, cell_footprint
from .point_cloud import PointCloudProjector, project_points

__all__ = ["Footprint", "PointCloudProjector", "cell_footprint", "project_points"]

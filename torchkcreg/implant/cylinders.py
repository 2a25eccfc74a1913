"""Straight cylinders as meshes and as point clouds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh

from torchkcreg.implant.point_cloud import ImplantPointCloud


def cylinder_mesh(
    start: Sequence[float], end: Sequence[float], radius: float, *, sections: int = 64
) -> trimesh.Trimesh:
    """Closed mesh of a straight cylinder between two points in mm, a prism of exactly the cylinder's volume.

    Raises:
        ValueError: the points coincide, or radius is not positive.

    >>> round(float(cylinder_mesh((0, 0, 0), (0, 0, 10), 2.0).volume / (10 * 4 * math.pi)), 9)
    1.0
    """
    segment = np.asarray([start, end], dtype=np.float64)
    if segment.shape != (2, 3) or not np.isfinite(segment).all() or not np.linalg.norm(segment[1] - segment[0]) > 0:
        raise ValueError(f"start and end must be two different points (x, y, z), got {start} and {end}")
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be a positive length in mm, got {radius}")
    if sections < 3:
        raise ValueError(f"sections must be at least 3, got {sections}")
    turn = 2 * math.pi / sections
    return trimesh.creation.cylinder(radius * math.sqrt(turn / math.sin(turn)), segment=segment, sections=sections)


def cylinder_cloud(
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    pitch: float = 0.25,
    *,
    at_centroids: bool = True,
    dtype: torch.dtype = torch.float32,
) -> ImplantPointCloud:
    """Point cloud of a solid cylinder between two points in mm; options as in `ImplantPointCloud.from_mesh`.

    >>> round(cylinder_cloud((0, 0, 0), (3, 4, 0), 1.0, 0.5).volume / (5 * math.pi), 6)
    1.0
    """
    mesh = cylinder_mesh(start, end, radius)
    return ImplantPointCloud.from_mesh(mesh, pitch, at_centroids=at_centroids, dtype=dtype)

"""Components of an assembly: a plate and its screws, each with a point cloud, a material and a motion of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.implant.point_cloud import ImplantPointCloud


@dataclass(frozen=True, eq=False)
class Component:
    """A rigid part that is fixed to an implant near one of its ends, like a screw near its head.

    Attributes:
        name: how results refer to it.
        cloud: its nodes, in the implant's frame.
        material: name of its material.
        head: (3,) point in the implant's frame, in mm, whose surroundings it moves with.
        axis: (3,) direction from the head to the tip; a unit vector.

    >>> screw = Component.screw("s1", (0, 0, 0), (0, 20, 0), radius=1.75, pitch=0.5)
    >>> screw.axis.tolist(), round(screw.cloud.volume, 2)
    ([0.0, 1.0, 0.0], 192.42)
    """

    name: str
    cloud: ImplantPointCloud
    material: str
    head: Tensor
    axis: Tensor

    def __post_init__(self) -> None:
        if self.head.shape != (3,) or self.axis.shape != (3,):
            raise ValueError(
                f"head and axis must have shape (3,), got {tuple(self.head.shape)} and {tuple(self.axis.shape)}"
            )
        length = self.axis.norm()
        if not bool(length > 0):
            raise ValueError(f"axis must not be zero, got {self.axis.tolist()}")
        object.__setattr__(self, "axis", self.axis / length)

    @classmethod
    def screw(
        cls,
        name: str,
        head: Sequence[float],
        tip: Sequence[float],
        radius: float,
        *,
        material: str = "steel",
        pitch: float = 0.25,
        at_centroids: bool = True,
        dtype: torch.dtype = torch.float32,
    ) -> Component:
        """A screw as a cylinder of solid material from the centre of its head to its tip, in mm."""
        cloud = cylinder_cloud(head, tip, radius, pitch, at_centroids=at_centroids, dtype=dtype)
        start = torch.tensor([float(x) for x in head], dtype=dtype)
        end = torch.tensor([float(x) for x in tip], dtype=dtype)
        return cls(name, cloud, material, start, end - start)


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

"""Screws, modelled as solid cylinders in the implant's frame: enough for their X-ray shadow."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import across, rotation_about, transform_points

from .point_cloud import ImplantPointCloud

Point = tuple[float, float, float]
_COMMON_LENGTH_MM, _COMMON_RADIUS_MM = 24.0, 2.0  # about the dimensions of most screws


def cylinder_mesh(
    start: Sequence[float], end: Sequence[float], radius: float, *, sections: int = 64
) -> trimesh.Trimesh:
    """Closed mesh of a straight cylinder between two points, mm: a prism of exactly the cylinder's volume.

    Raises:
        ValueError: If the points coincide or the radius is not positive.

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


@dataclass(frozen=True)
class Screw:
    """A cylinder in the implant's frame, mm.

    Attributes:
        start: Centre (x, y, z) of the head end, in the opening of the hole.
        end: Tip (x, y, z).
        radius: Radius of the shaft.
        material: Name of the material.
        name: Name of the screw in results.

    Raises:
        ValueError: If start and end coincide, are not three finite numbers each, or the radius is not positive.

    >>> screw = Screw((0, 0, 0), (0, 0, 20), 1.75)
    >>> screw.length, round(float(screw.mesh().volume), 2)
    (20.0, 192.42)
    """

    start: Point
    end: Point
    radius: float
    material: str = "steel"
    name: str = "screw"

    def __post_init__(self) -> None:
        for which in ("start", "end"):
            object.__setattr__(self, which, _triple(getattr(self, which), which))
        object.__setattr__(self, "radius", float(self.radius))
        if not self.length > 0:
            raise ValueError(f"start and end of {self.name} must be two different points, got {self.start} twice")
        if not 0 < self.radius < np.inf:
            raise ValueError(f"radius of {self.name} must be a positive length in mm, got {self.radius}")

    @property
    def length(self) -> float:
        """Length from start to end, mm."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def with_length(self, length: float) -> Screw:
        """Copy with another length, mm; the start stays."""
        axis = np.subtract(self.end, self.start) / self.length
        return replace(self, end=tuple(np.add(self.start, length * axis)))

    def with_radius(self, radius: float) -> Screw:
        """Copy with another radius, mm."""
        return replace(self, radius=radius)

    def same_side(self, other: Screw) -> bool:
        """True if two screws point the same way."""
        return float(np.subtract(self.end, self.start) @ np.subtract(other.end, other.start)) > 0

    def overlaps(self, other: Screw) -> bool:
        """True if two screws overlap: in the same hole, or side by side in a combination hole."""
        way = np.subtract(self.start, other.start)
        axis = np.subtract(other.end, other.start) / other.length
        return float(np.linalg.norm(way - (way @ axis) * axis)) < self.radius + other.radius

    def moved(self, rotation: Tensor, shift: Tensor) -> Screw:
        """Copy rotated about its start by a rotation vector (3,) and then shifted by a vector (3,), mm."""
        ends = torch.tensor([self.start, self.end], dtype=torch.float64, device="cpu")
        turned = transform_points(rotation_about(ends[0], rotation.cpu().double()), ends) + shift.cpu().double()
        return replace(self, start=tuple(turned[0].tolist()), end=tuple(turned[1].tolist()))

    def moved_by(self, motion: Tensor) -> Screw:
        """Copy after a rigid motion (4, 4)."""
        ends = torch.tensor([self.start, self.end], dtype=torch.float64, device="cpu")
        start, end = transform_points(motion.detach().cpu().double(), ends).tolist()
        return replace(self, start=tuple(start), end=tuple(end))

    def mesh(self) -> trimesh.Trimesh:
        """Surface of the screw, a prism of exactly its volume."""
        return cylinder_mesh(self.start, self.end, self.radius)

    def cloud(self, pitch: float = 0.25, *, dtype: torch.dtype = torch.float32) -> ImplantPointCloud:
        """Point cloud of the screw, with nodes `pitch` mm apart."""
        return cylinder_cloud(self.start, self.end, self.radius, pitch, dtype=dtype)

    def stretched_cloud(self, pitch: float) -> ImplantPointCloud:
        """Point cloud of the screw, stretched from that of a standard screw: fast, but on a stretched lattice."""
        common = _common_cloud(pitch)
        start, end = (torch.tensor(p, dtype=torch.float64, device="cpu") for p in (self.start, self.end))
        axis = (end - start) / (end - start).norm()
        thicker, longer = self.radius / _COMMON_RADIUS_MM, self.length / _COMMON_LENGTH_MM
        stretch = axis.new_tensor([[thicker], [thicker], [longer]]) * torch.cat([across(axis), axis[None]])
        return common.mapped(stretch, start)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain types, for files."""
        return {
            "start": list(self.start),
            "end": list(self.end),
            "radius": self.radius,
            "material": self.material,
            "name": self.name,
        }


def _triple(values: Any, name: str) -> Point:
    numbers = tuple(float(x) for x in values)
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be three finite numbers in mm, got {numbers}")
    return numbers


@functools.cache
def _common_cloud(pitch: float) -> ImplantPointCloud:
    tip = (0.0, 0.0, _COMMON_LENGTH_MM)
    return cylinder_cloud((0.0, 0.0, 0.0), tip, _COMMON_RADIUS_MM, pitch, dtype=torch.float64)

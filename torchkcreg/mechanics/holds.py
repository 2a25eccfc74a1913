"""Holds: places where an implant may be fixed and loaded (its holes, or patches along it), and unit loads there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchkcreg.implant import Hole, ImplantPointCloud

_RIM_MM = 1.5  # width of the rim around a hole that a screw's head presses on
_JOINED = 2.2  # in radii: distance of the centres of round holes that open into each other
_SPACING = 3.0  # least spacing of patches, in widths of the implant's cross-section
_MOST_PATCHES = 12
_FEWEST_HOLES = 3
_SPANNED = 0.5  # least share of the implant's length that its holes must span


def rigid_fields(positions: Tensor) -> Tensor:
    """Displacements (6, N, 3) of positions (N, 3) for a unit shift along and a small unit rotation about each axis."""
    axes = torch.eye(3, dtype=positions.dtype, device=positions.device)
    shifts = axes[:, None].expand(3, len(positions), 3)
    turns = torch.linalg.cross(axes[:, None].expand_as(shifts), positions[None].expand_as(shifts))
    return torch.cat([shifts, turns])


@dataclass(frozen=True)
class Hold:
    """A place where an implant may be held and loaded.

    Attributes:
        name: Its name in results.
        center: Point where its force acts and about which its moment is taken, (3,) in the implant's frame, mm.
        radius: Nodes within this distance belong to the hold, mm.
        axis: Direction of the axis, for a hole. The radius is then measured from the axis, the half depth along it.
        half_depth: Half the depth of a hole, mm.
    """

    name: str
    center: tuple[float, float, float]
    radius: float
    axis: tuple[float, float, float] | None = None
    half_depth: float = 0.0

    def nodes(self, points: Tensor) -> Tensor:
        """Indices of the nodes (N, 3) that belong to the hold; the three nearest if fewer than three do."""
        away = points.double() - points.new_tensor(self.center, dtype=torch.float64)
        distance = away.norm(dim=-1)
        if self.axis is None:
            inside = distance <= self.radius
        else:
            along = away @ points.new_tensor(self.axis, dtype=torch.float64)
            across = (distance.square() - along.square()).clamp_min(0).sqrt()
            inside = (across <= self.radius) & (along.abs() <= self.half_depth + _RIM_MM)
        members = inside.nonzero().flatten()
        return members if len(members) >= 3 else distance.argsort()[:3]


def holds_of(cloud: ImplantPointCloud, holes: Sequence[Hole] = ()) -> list[Hold]:
    """Holds of an implant: its holes, or patches along it if the holes are few or span less than half its length."""
    middle, axes, extents = (x.double() for x in cloud.principal_axes())
    along, length = axes[-1], float(extents[-1])
    places: list[list[Hole]] = []
    for hole in holes:
        overlapping = [
            p for p in places if min(np.linalg.norm(h.center - hole.center) for h in p) < _JOINED * hole.radius
        ]
        if overlapping:
            overlapping[0].append(hole)
        else:
            places.append([hole])
    holds = [_at(number, place) for number, place in enumerate(places, start=1)]
    heights = [float(along.new_tensor(h.center) @ along) for h in holds]
    if len(holds) >= _FEWEST_HOLES and max(heights) - min(heights) >= _SPANNED * length:
        return holds
    return _patches(cloud, middle, along, length, float(extents[:-1].max()))


def _at(number: int, holes: Sequence[Hole]) -> Hold:
    """Hold of one hole, or of the holes of a combination hole."""
    center, first = np.mean([hole.center for hole in holes], axis=0), holes[0]
    reach = max(float(np.linalg.norm(hole.center - center)) + hole.radius for hole in holes) + _RIM_MM
    middle, axis = (tuple(float(x) for x in vector) for vector in (center, first.axis))
    return Hold(f"hole {number}", middle, reach, axis, first.depth / 2)  # type: ignore[arg-type]


def _patches(cloud: ImplantPointCloud, middle: Tensor, along: Tensor, length: float, width: float) -> list[Hold]:
    number = max(_FEWEST_HOLES, min(_MOST_PATCHES, round(length / (_SPACING * width)) + 1))
    points = cloud.points.double()
    height = (points - middle) @ along
    low, high = float(height.min()), float(height.max())
    spacing = (high - low) / number
    holds = []
    for index in range(number):
        in_patch = (height - (low + (index + 0.5) * spacing)).abs() <= spacing / 2
        center = points[in_patch if bool(in_patch.any()) else slice(None)].mean(0)
        holds.append(Hold(f"patch {index + 1}", tuple(center.tolist()), min(width, spacing) / 2))
    return holds


def unit_loads(cloud: ImplantPointCloud, holds: Sequence[Hold]) -> tuple[list[Tensor], list[Tensor]]:
    """Points (P, 3) and forces (P, 3) of six unit loads per hold: 1 N along and 1 N mm about each axis.

    The metal of a hold moves almost rigidly, so forces are distributed over it like those on a rigid body. Moments are
    about the hold's centre.
    """
    places, forces = [], []
    for hold in holds:
        nodes = hold.nodes(cloud.points)
        points, volumes = cloud.points[nodes].double(), cloud.volumes[nodes].double()[:, None]
        arms = points - points.new_tensor(hold.center)
        spread = rigid_fields(arms) * volumes
        wrench = torch.stack([_wrench(arms, field) for field in spread], dim=-1)  # (6, 6): resultant of each field
        loads = torch.einsum("kl,kpi->lpi", torch.linalg.inv(wrench), spread)
        places += [points] * 6
        forces += list(loads)
    return places, forces


def _wrench(arms: Tensor, forces: Tensor) -> Tensor:
    return torch.cat([forces.sum(0), torch.linalg.cross(arms, forces).sum(0)])

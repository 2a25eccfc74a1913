"""Motion of bone fragments and deflection of the implant between two registrations, with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, invert_rigid, principal_axes, transform_points, vector_from_rotation
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import RegisteredImplant

from .fragments import Fragments

_STATIONS = 49
AXES = ("across", "out of plane", "along")


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Motion of the upper fragment relative to the lower one, from a first registration to a second.

    Vectors are in the implant's axes at its pose in the first registration: across (its width), out of plane (away from
    the bone if there are screws), along (from the lower to the upper fragment).

    Attributes:
        axes: The axes in the world as rows, (3, 3).
        motion: Rigid motion (4, 4) of the upper fragment in the world, with the lower fragment held fixed.
        lower_motion: Rigid motion (4, 4) of the lower fragment in the world: how the limb lies otherwise.
        rotation_deg: Rotation vector (3,) of the motion, degrees.
        rotation_std_deg: Its standard deviations.
        translation_mm: Translation (3,) at the gap, mm.
        translation_std_mm: Its standard deviations.
        gap: The gap's position (3,) in the implant's frame.
        heights: Heights (S,) of stations, mm from the implant's lower end.
        deflection_mm: Displacements (S, 3) of the implant at the stations relative to the lower fragment.
        deflection_std_mm: Their standard deviations.
        angle_deg: Angle of the rotation and its standard deviation, degrees, (2,).
        places: Further points (P, 3) of the upper fragment in the implant's frame.
        places_mm: Their translations (P, 3), mm.
        places_std_mm: Standard deviations of these.
        lengths_mm: Lengths of their translations and standard deviations, (P, 2), mm.
        fragments: Names of the screws in the lower and the upper fragment.
    """

    axes: Tensor
    motion: Tensor
    lower_motion: Tensor
    rotation_deg: Tensor
    rotation_std_deg: Tensor
    translation_mm: Tensor
    translation_std_mm: Tensor
    gap: Tensor
    heights: Tensor
    deflection_mm: Tensor
    deflection_std_mm: Tensor
    angle_deg: Tensor
    places: Tensor
    places_mm: Tensor
    places_std_mm: Tensor
    lengths_mm: Tensor
    fragments: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def numbers(self) -> tuple[Tensor, Tensor]:
        """Rotation (degrees) and translation (mm), (6,), and their standard deviations."""
        values = torch.cat([self.rotation_deg, self.translation_mm])
        return values, torch.cat([self.rotation_std_deg, self.translation_std_mm])

    def to_dict(self) -> dict[str, Any]:
        """The results as a dictionary of tensors and names, with units in the keys."""
        stations = {"height_mm": self.heights, "deflection_mm": self.deflection_mm}
        return {
            "axes": dict(zip(AXES, self.axes, strict=True)),
            "screws": dict(zip(("lower", "upper"), self.fragments, strict=True)),
            "rotation_deg": self.rotation_deg,
            "rotation_std_deg": self.rotation_std_deg,
            "translation_mm": self.translation_mm,
            "translation_std_mm": self.translation_std_mm,
            "gap_mm": self.gap,
            "motion": self.motion,
            "lower_motion": self.lower_motion,
            "stations": {**stations, "deflection_std_mm": self.deflection_std_mm},
        }

    def __str__(self) -> str:
        lines = []
        for name, vector, std, unit in (
            ("rotation", self.rotation_deg, self.rotation_std_deg, "degrees"),
            ("translation at the gap", self.translation_mm, self.translation_std_mm, "mm"),
        ):
            parts = (
                f"{axis} {v:.3f} +- {s:.3f}" for axis, v, s in zip(AXES, vector.tolist(), std.tolist(), strict=True)
            )
            lines.append(f"{name} of the upper fragment ({unit}): {', '.join(parts)}; size {float(vector.norm()):.3f}")
        return "\n".join(lines)


@torch.no_grad()
def relative_motion(
    first: RegisteredImplant,
    second: RegisteredImplant,
    cloud: ImplantPointCloud,
    fragments: Fragments,
    *,
    to_second: Tensor | None = None,
    places: Tensor | None = None,
) -> RelativeMotion:
    """Motion of one bone fragment relative to the other between two registrations of an implant.

    Standard deviations combine the uncertainties of both registrations, assumed independent: each displacement field of
    their `deviations` is added to the warped points, and the squared changes of the results are summed. They are NaN if
    a registration has no `deviations`.

    Args:
        first: First registration, usually without load.
        second: Second registration, usually with load.
        cloud: The undeformed implant in the first registration's frame.
        fragments: Fragments in the first registration's frame; exchanged if the upper one is lower in the world.
        to_second: Rigid transform (4, 4) from the first registration's frame of the implant to the second's.
        places: Points (P, 3) in the first registration's frame of the implant that move with the upper fragment, such
            as on the bone's axis, whose translations are wanted.
    """
    nodes = cloud.points.double()
    places = nodes[:0] if places is None else places.to(nodes)
    count = len(places)
    upwards = first.warp(fragments.upper).mean(0) - first.warp(fragments.lower).mean(0)
    if float(upwards[2]) < 0:
        fragments, upwards = fragments.swapped(), -upwards
    axes = _axes(first, nodes, upwards)
    heights, centers = _stations(cloud, first.warp(nodes) @ axes[2])
    groups = (fragments.lower, fragments.upper, torch.cat([fragments.gap[None], places]), centers)
    points = torch.cat(groups)
    in_second = points if to_second is None else transform_points(to_second, points)
    sizes = [len(group) for group in groups]

    def motions(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse motion of the lower fragment, and motion of the upper one relative to it."""
        (low0, up0, *_), (low1, up1, *_) = before.split(sizes), after.split(sizes)
        back = invert_rigid(fit_rigid(low0, low1))
        return back, back @ fit_rigid(up0, up1)

    def numbers(before: Tensor, after: Tensor) -> Tensor:
        (*_, spots, line), (*_, moved) = before.split(sizes), after.split(sizes)
        back, motion = motions(before, after)
        turned = torch.rad2deg(axes @ vector_from_rotation(motion[:3, :3]))
        shifted = (transform_points(motion, spots) - spots) @ axes.mT  # of the gap, then of the places
        bent = (transform_points(back, moved) - line) @ axes.mT
        lengths = torch.cat([turned.norm()[None], shifted[1:].norm(dim=-1)])
        return torch.cat([turned, shifted.flatten(), lengths, bent.flatten()])

    before, after = first.warp(points), second.warp(in_second)
    values = numbers(before, after)
    squares = torch.zeros_like(values)
    if first.deviations is not None:
        for field in first.deviations.at(points):
            squares += (numbers(before + field, after) - values).square()
    if second.deviations is not None:
        for field in second.deviations.at(in_second):
            squares += (numbers(before, after + field) - values).square()
    unknown = first.deviations is None or second.deviations is None
    std = torch.full_like(values, torch.nan) if unknown else squares.sqrt()
    parts = [3, 3, 3 * count, 1, count, 3 * len(centers)]
    turn, shift, there, angle, lengths, bend = values.split(parts)
    turn_std, shift_std, there_std, angle_std, lengths_std, bend_std = std.split(parts)
    back, motion = motions(before, after)
    return RelativeMotion(
        axes=axes,
        motion=motion,
        lower_motion=invert_rigid(back),
        rotation_deg=turn,
        rotation_std_deg=turn_std,
        translation_mm=shift,
        translation_std_mm=shift_std,
        gap=fragments.gap,
        heights=heights,
        deflection_mm=bend.unflatten(0, (-1, 3)),
        deflection_std_mm=bend_std.unflatten(0, (-1, 3)),
        angle_deg=torch.cat([angle, angle_std]),
        places=places,
        places_mm=there.reshape(count, 3),
        places_std_mm=there_std.reshape(count, 3),
        lengths_mm=torch.stack([lengths, lengths_std], dim=1),
        fragments=fragments.names,
    )


def _axes(implant: RegisteredImplant, nodes: Tensor, upwards: Tensor) -> Tensor:
    """The implant's axes in the world, (3, 3): across, out of plane, along; independent of its frame."""
    _, (thin, _, along) = principal_axes(nodes)
    turn = fit_rigid(nodes, implant.warp(nodes))[:3, :3]
    thin, along = turn @ thin, turn @ along
    along = along if float(along @ upwards) > 0 else -along
    if implant.screws:
        shafts = torch.stack([nodes.new_tensor(s.start) - nodes.new_tensor(s.end) for s in implant.screws]).mean(0)
        outwards = turn @ shafts
    else:
        outwards = thin * thin[thin.abs().argmax()].sign()  # without screws: towards the nearest positive world axis
    thin = thin if float(thin @ outwards) > 0 else -thin
    return torch.stack([torch.linalg.cross(thin, along), thin, along])


def _stations(cloud: ImplantPointCloud, height: Tensor) -> tuple[Tensor, Tensor]:
    """Heights (S,) from the lower end, and centres (S, 3) of the implant there, in its frame."""
    low, high = height.aminmax()
    heights = torch.linspace(0, 1, _STATIONS, dtype=torch.float64) * (high - low)
    spacing = heights[1]
    weights = (1 - ((height - low)[:, None] - heights).abs() / spacing).clamp_min(0) * cloud.volumes.double()[:, None]
    return heights, weights.T @ cloud.points.double() / weights.sum(0)[:, None]

"""How an implant, and the fragments it holds, moved between two registrations, and how sure that is."""

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
    """The motion of the upper fragment against the lower one, from a first registration to a second.

    Vectors are in the implant's axes where the first registration has it: across (its width), out of plane (away from
    the bone, where screws tell), along (from the lower to the upper fragment).

    Attributes:
        axes: Those axes in the world, (3, 3), one a row.
        motion: The rigid motion (4, 4) in the world, as if the lower fragment had not moved.
        rotation_deg: Its rotation vector (3,), degrees.
        rotation_std_deg: Standard deviations.
        translation_mm: Of the gap, (3,), mm.
        translation_std_mm: Standard deviations.
        gap: Where that is, (3,), in the implant's frame.
        heights: Of S stations, mm from the implant's lower end.
        deflection_mm: How far the implant moved there against the lower fragment, (S, 3).
        deflection_std_mm: Standard deviations.
        fragments: How each is told.
    """

    axes: Tensor
    motion: Tensor
    rotation_deg: Tensor
    rotation_std_deg: Tensor
    translation_mm: Tensor
    translation_std_mm: Tensor
    gap: Tensor
    heights: Tensor
    deflection_mm: Tensor
    deflection_std_mm: Tensor
    fragments: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def numbers(self) -> tuple[Tensor, Tensor]:
        """Rotation (degrees) and translation (mm), (6,), and their standard deviations."""
        found = torch.cat([self.rotation_deg, self.translation_mm])
        return found, torch.cat([self.rotation_std_deg, self.translation_std_mm])

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, with units in their names."""
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
            "stations": {**stations, "deflection_std_mm": self.deflection_std_mm},
        }

    def __str__(self) -> str:
        lines = []
        for name, found, std, unit in (
            ("rotation", self.rotation_deg, self.rotation_std_deg, "degrees"),
            ("translation at the gap", self.translation_mm, self.translation_std_mm, "mm"),
        ):
            parts = (
                f"{axis} {v:.3f} +- {s:.3f}" for axis, v, s in zip(AXES, found.tolist(), std.tolist(), strict=True)
            )
            lines.append(f"{name} of the upper fragment ({unit}): {', '.join(parts)}; size {float(found.norm()):.3f}")
        return "\n".join(lines)


@torch.no_grad()
def relative_motion(
    first: RegisteredImplant,
    second: RegisteredImplant,
    cloud: ImplantPointCloud,
    fragments: Fragments,
    *,
    to_second: Tensor | None = None,
) -> RelativeMotion:
    """The motion of one fragment against the other between two registrations of an implant.

    Deviations are those of both registrations, taken to be independent of each other: each of their fields is laid on
    the warped nodes, and what it changes is summed in squares.

    Args:
        first: Mostly without load.
        second: With it.
        cloud: The undeformed implant in the first registration's frame.
        fragments: In that frame; which of them is the lower one in the world is found out.
        to_second: Rigid transform (4, 4) from the first registration's frame of the implant to the second's.
    """
    nodes = cloud.points.double()
    upwards = first.warp(fragments.upper).mean(0) - first.warp(fragments.lower).mean(0)
    if float(upwards[2]) < 0:
        fragments, upwards = fragments.swapped(), -upwards
    axes = _axes(first, nodes, upwards)
    heights, centers = _stations(cloud, first.warp(nodes) @ axes[2])
    groups = (fragments.lower, fragments.upper, fragments.gap[None], centers)
    points = torch.cat(groups)
    in_second = points if to_second is None else transform_points(to_second, points)
    sizes = [len(group) for group in groups]

    def motions(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
        """What takes the lower fragment back, and the upper one's motion against it."""
        (low0, up0, *_), (low1, up1, *_) = before.split(sizes), after.split(sizes)
        back = invert_rigid(fit_rigid(low0, low1))
        return back, back @ fit_rigid(up0, up1)

    def numbers(before: Tensor, after: Tensor) -> Tensor:
        (*_, gap, line), (*_, moved) = before.split(sizes), after.split(sizes)
        back, motion = motions(before, after)
        turned = torch.rad2deg(axes @ vector_from_rotation(motion[:3, :3]))
        shifted = axes @ (transform_points(motion, gap) - gap)[0]
        return torch.cat([turned, shifted, ((transform_points(back, moved) - line) @ axes.mT).flatten()])

    before, after = first.warp(points), second.warp(in_second)
    found = numbers(before, after)
    squares = torch.zeros_like(found)
    if first.deviations is not None:
        for field in first.deviations.at(points):
            squares += (numbers(before + field, after) - found).square()
    if second.deviations is not None:
        for field in second.deviations.at(in_second):
            squares += (numbers(before, after + field) - found).square()
    unknown = first.deviations is None or second.deviations is None
    std = torch.full_like(found, torch.nan) if unknown else squares.sqrt()
    return RelativeMotion(
        axes=axes,
        motion=motions(before, after)[1],
        rotation_deg=found[:3],
        rotation_std_deg=std[:3],
        translation_mm=found[3:6],
        translation_std_mm=std[3:6],
        gap=fragments.gap,
        heights=heights,
        deflection_mm=found[6:].unflatten(0, (-1, 3)),
        deflection_std_mm=std[6:].unflatten(0, (-1, 3)),
        fragments=fragments.names,
    )


def _axes(implant: RegisteredImplant, nodes: Tensor, upwards: Tensor) -> Tensor:
    """The implant's axes in the world, (3, 3): across, out of plane, along; the same whatever its frame."""
    _, (thin, _, along) = principal_axes(nodes)
    turn = fit_rigid(nodes, implant.warp(nodes))[:3, :3]
    thin, along = turn @ thin, turn @ along
    along = along if float(along @ upwards) > 0 else -along
    if implant.screws:
        shafts = torch.stack([nodes.new_tensor(s.start) - nodes.new_tensor(s.end) for s in implant.screws]).mean(0)
        outwards = turn @ shafts
    else:
        outwards = thin * thin[thin.abs().argmax()].sign()  # whichever way points along the world's axes
    thin = thin if float(thin @ outwards) > 0 else -thin
    return torch.stack([torch.linalg.cross(thin, along), thin, along])


def _stations(cloud: ImplantPointCloud, height: Tensor) -> tuple[Tensor, Tensor]:
    """Heights (S,) from the lower end, and centres (S, 3) of the implant there, in its frame."""
    low, high = height.aminmax()
    heights = torch.linspace(0, 1, _STATIONS, dtype=torch.float64) * (high - low)
    spacing = heights[1]
    weights = (1 - ((height - low)[:, None] - heights).abs() / spacing).clamp_min(0) * cloud.volumes.double()[:, None]
    return heights, weights.T @ cloud.points.double() / weights.sum(0)[:, None]

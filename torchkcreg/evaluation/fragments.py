"""The two fragments of a fractured bone, and places on the bone, as an implant and its screws show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import fit_rigid, principal_axes, transform_points, vector_from_rotation
from torchkcreg.implant import Screw
from torchkcreg.mechanics import fracture_among
from torchkcreg.registration import RegisteredImplant

BONE_PLACES = ("near cortex", "bone axis", "far cortex")
_AROUND_MM = 4.0  # of the implant's length, where its thickness is measured
_SHAFT_POINTS = 11
_FEWEST_NODES = 12


@dataclass(frozen=True, eq=False)
class Fragments:
    """Two bone fragments, each represented by the nodes of the implant that are fixed to it.

    Attributes:
        lower: Nodes (N, 3) of the lower fragment in the implant's frame, mm.
        upper: Nodes (M, 3) of the upper fragment.
        gap: Point (3,) in the implant's frame where the translation is measured: between the fragments, at the centre
            of the implant's cross-section.
        names: Names of the screws in each; empty without screws.
    """

    lower: Tensor
    upper: Tensor
    gap: Tensor
    names: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    def swapped(self) -> Fragments:
        """The same with lower and upper fragment exchanged."""
        return Fragments(self.upper, self.lower, self.gap, self.names[::-1])


def fracture_plane(
    first: RegisteredImplant, others: Sequence[tuple[RegisteredImplant, Tensor | None]], nodes: Tensor
) -> tuple[Tensor, None] | None:
    """Plane between those neighbouring screws that turned most against each other, for `fragments_of`; None without.

    Screws of one fragment turn together, so that the implant bends at the fracture. See `fracture_among`.

    Args:
        first: Registration without load.
        others: Registrations under load, each with the rigid transform (4, 4) from the first one's frame of the implant
            to its own; None for the same frame.
        nodes: Nodes (N, 3) of the undeformed implant in the first one's frame.
    """
    nodes = nodes.double()
    middle, (*_, axis) = principal_axes(nodes)
    heads = _heads(first.screws)
    if len(heads) < 2 or not others:
        return None
    near = _near(heads, nodes, first.follow_radius_mm)
    turns = []
    for other, change in others:
        there = nodes if change is None else transform_points(change, nodes)
        before, after = first.warp(nodes), other.warp(there)
        motions = [fit_rigid(before[mine], after[mine]) for mine in near]
        turns.append(torch.stack([vector_from_rotation(motions[0][:3, :3].T @ m[:3, :3]) for m in motions]))
    heights = (heads - middle) @ axis
    bent = torch.cat(turns, dim=1)
    height = fracture_among(heights, bent)
    return None if height is None else (middle + height * axis, None)


def fragments_of(
    nodes: Tensor,
    screws: Sequence[Screw],
    *,
    radius_mm: float = 8.0,
    plane: tuple[Tensor, Tensor | None] | None = None,
    mesh: trimesh.Trimesh | None = None,
) -> Fragments:
    """Fragments of the bone under an implant.

    Screws are assigned to the lower or the upper fragment: by the widest gap between their heads along the implant, by
    a plane, or by the surface of one fragment that holds most of their shafts. Each fragment is represented by the
    implant's nodes near the heads of its screws. Without screws the two end thirds of the implant are used, or all
    nodes on either side of a plane.

    Args:
        nodes: Nodes (N, 3) of the undeformed implant in its frame, mm.
        screws: Screws of the implant.
        radius_mm: Nodes within this distance of a screw's head are used.
        plane: A point (3,) of the fracture plane and its normal (3,); a normal of None is the implant's long axis.
        mesh: Surface of one fragment in the implant's frame; it becomes the upper one.

    Raises:
        ValueError: If all screws, or hardly any nodes, belong to one fragment.
    """
    nodes = nodes.double()
    middle, (*_, axis) = principal_axes(nodes)
    heads = _heads(screws)
    if plane is not None:
        point, normal = plane
        axis = axis if normal is None else torch.nn.functional.normalize(normal.to(axis), dim=0)
        middle = point.to(nodes)
    height = (nodes - middle) @ axis
    if mesh is not None:
        if not screws:
            raise ValueError("a fragment's mesh assigns screws to fragments, but the implant has no screws")
        inside = torch.tensor([_share_inside(mesh, screw) > 0.5 for screw in screws])
    elif plane is not None:
        inside = (heads - middle) @ axis > 0
    else:
        fracture = fracture_among(heads @ axis)
        inside = heads @ axis > (torch.inf if fracture is None else fracture)
    if not screws:
        reach = height.abs().max() / 3 if plane is None else 0.0
        return _fragments([nodes[height < -reach], nodes[height > reach]], middle, ((), ()))
    if bool(inside.all()) or not bool(inside.any()):
        raise ValueError(f"all {len(screws)} screws belong to one fragment: give the plane of the fracture")
    near = _near(heads, nodes, radius_mm)
    sides = [~inside, inside]
    gap = torch.stack([_innermost(heads[side], heads[~side]) for side in sides]).mean(0)
    gap = _in_the_middle(nodes, gap)
    below, above = (
        tuple(s.name for s, is_member in zip(screws, side.tolist(), strict=True) if is_member) for side in sides
    )
    return _fragments([nodes[near[side].any(0)] for side in sides], gap, (below, above))


def _fragments(parts: list[Tensor], gap: Tensor, names: tuple[tuple[str, ...], tuple[str, ...]]) -> Fragments:
    for part, name in zip(parts, ("lower", "upper"), strict=True):
        if len(part) < _FEWEST_NODES:
            raise ValueError(f"only {len(part)} nodes of the implant belong to the {name} fragment")
    lower, upper = parts
    return Fragments(lower, upper, gap, names)


def _heads(screws: Sequence[Screw]) -> Tensor:
    """Heads of the screws, (C, 3)."""
    return torch.tensor([screw.start for screw in screws], dtype=torch.float64).reshape(-1, 3)


def _near(heads: Tensor, nodes: Tensor, radius_mm: float) -> Tensor:
    """True for the nodes (N, 3) within a radius of each head (C, 3), or nearest to it, (C, N)."""
    distance = torch.cdist(heads, nodes)
    return distance <= distance.amin(1, keepdim=True).clamp_min(radius_mm)


def _share_inside(mesh: trimesh.Trimesh, screw: Screw) -> float:
    places = np.linspace(screw.start, screw.end, _SHAFT_POINTS)
    return float(mesh.contains(places).mean())


def _innermost(heads: Tensor, other_heads: Tensor) -> Tensor:
    """The head that is nearest to those of the other fragment."""
    return heads[torch.cdist(heads, other_heads).amin(1).argmin()]


def _in_the_middle(nodes: Tensor, point: Tensor) -> Tensor:
    """Centre of the implant's cross-section at the height of a point."""
    _, (*_, axis) = principal_axes(nodes)
    height = ((nodes - point) @ axis).abs()
    center = nodes[height <= height.sort().values[len(nodes) // 50 + 1] + 1e-9].mean(0)
    return center + ((point - center) @ axis) * axis


def bone_places(nodes: Tensor, screws: Sequence[Screw], gap: Tensor) -> Tensor:
    """Points (3, 3) on the near cortex, the bone's axis and the far cortex at the fracture, in the implant's frame.

    Screws of a plate go through both cortices. The near cortex is taken where their mean direction leaves the implant,
    the far cortex at the median depth of their tips, and the axis half-way.

    Args:
        nodes: Nodes (N, 3) of the undeformed implant, mm.
        screws: Its screws, from head to tip, in the same frame.
        gap: Point (3,) of the fracture at the centre of the implant's cross-section.

    Raises:
        ValueError: If there are no screws.
    """
    if not screws:
        raise ValueError("without screws it is not known where the bone is")
    nodes, gap = nodes.double(), gap.double()
    heads, tips = (torch.tensor([getattr(s, end) for s in screws], dtype=torch.float64) for end in ("start", "end"))
    directions = torch.nn.functional.normalize(tips - heads, dim=-1)
    down = torch.nn.functional.normalize(directions.mean(0), dim=0)
    beside = nodes - gap
    across = beside - (beside @ down)[:, None] * down
    near = across.norm(dim=-1) <= across.norm(dim=-1).kthvalue(max(1, len(nodes) // 50)).values.clamp_min(_AROUND_MM)
    underside = float((beside[near] @ down).max())
    # a tip's depth below its own head, from the level of the heads' side of the implant
    depth = float((torch.linalg.vecdot(tips - heads, down.expand_as(heads))).median()) + float(
        (beside[near] @ down).min()
    )
    depths = torch.tensor([underside, (underside + depth) / 2, depth], dtype=torch.float64)
    return gap + depths[:, None] * down

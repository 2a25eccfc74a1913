"""Which parts of an implant move with one fragment of a bone, which with the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import principal_axes
from torchkcreg.implant import Screw

_SHAFT_POINTS = 11
_FEWEST_NODES = 12


@dataclass(frozen=True, eq=False)
class Fragments:
    """Two fragments, each told by the nodes of the implant that are fixed to it.

    Attributes:
        lower: Nodes (N, 3) in the implant's frame, mm.
        upper: Those of the other one.
        gap: The point (3,) of the implant's frame where their motion is told: between them, in the implant's middle.
        names: Of the screws in each; empty where no screws told them.
    """

    lower: Tensor
    upper: Tensor
    gap: Tensor
    names: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    def swapped(self) -> Fragments:
        """The other one first."""
        return Fragments(self.upper, self.lower, self.gap, self.names[::-1])


def fragments_of(
    nodes: Tensor,
    screws: Sequence[Screw],
    *,
    radius_mm: float = 8.0,
    plane: tuple[Tensor, Tensor | None] | None = None,
    mesh: trimesh.Trimesh | None = None,
) -> Fragments:
    """Fragments of the bone under an implant.

    Screws belong to the lower or the upper one: by the widest gap between their heads along the implant, by a plane, or
    by the surface of one fragment that holds most of their shafts. The implant's nodes near their heads tell how it
    moves. Without screws the thirds of the implant at its ends do, or all on either side of a plane.

    Args:
        nodes: Of the undeformed implant, (N, 3), in its frame, mm.
        screws: Of it.
        radius_mm: How near to a screw's head nodes move with it.
        plane: A point (3,) of it and its normal (3,); along the implant when None.
        mesh: One fragment's surface in the implant's frame; it is the upper one then.

    Raises:
        ValueError: If all screws, or hardly any nodes, belong to one fragment.
    """
    nodes = nodes.double()
    middle, (*_, axis) = principal_axes(nodes)
    heads = torch.stack([middle, *(nodes.new_tensor(screw.start) for screw in screws)])[1:]
    if plane is not None:
        point, normal = plane
        axis = axis if normal is None else torch.nn.functional.normalize(normal.to(axis), dim=0)
        middle = point.to(nodes)
    height = (nodes - middle) @ axis
    if mesh is not None:
        if not screws:
            raise ValueError("a fragment's mesh tells fragments by their screws, and there are none")
        inside = torch.tensor([_share_inside(mesh, screw) > 0.5 for screw in screws])
    elif plane is not None:
        inside = (heads - middle) @ axis > 0
    else:
        inside = _beyond_the_widest_gap(heads @ axis)
    if not screws:
        reach = height.abs().max() / 3 if plane is None else 0.0
        return _fragments([nodes[height < -reach], nodes[height > reach]], middle, ((), ()))
    if bool(inside.all()) or not bool(inside.any()):
        raise ValueError(f"all {len(screws)} screws belong to one fragment: say where the fracture is by a plane")
    near = torch.cdist(heads, nodes) <= torch.cdist(heads, nodes).amin(1, keepdim=True).clamp_min(radius_mm)
    sides = [~inside, inside]
    gap = torch.stack([_innermost(heads[side], heads[~side]) for side in sides]).mean(0)
    gap = _in_the_middle(nodes, gap)
    below, above = (tuple(s.name for s, here in zip(screws, side.tolist(), strict=True) if here) for side in sides)
    return _fragments([nodes[near[side].any(0)] for side in sides], gap, (below, above))


def _fragments(parts: list[Tensor], gap: Tensor, names: tuple[tuple[str, ...], tuple[str, ...]]) -> Fragments:
    for part, name in zip(parts, ("lower", "upper"), strict=True):
        if len(part) < _FEWEST_NODES:
            raise ValueError(f"only {len(part)} nodes of the implant belong to the {name} fragment")
    lower, upper = parts
    return Fragments(lower, upper, gap, names)


def _beyond_the_widest_gap(heights: Tensor) -> Tensor:
    order = heights.sort().values
    if len(order) < 2:
        return heights > torch.inf
    widest = int(order.diff().argmax())
    return heights > (order[widest] + order[widest + 1]) / 2


def _share_inside(mesh: trimesh.Trimesh, screw: Screw) -> float:
    places = np.linspace(screw.start, screw.end, _SHAFT_POINTS)
    return float(mesh.contains(places).mean())


def _innermost(own: Tensor, others: Tensor) -> Tensor:
    """The head that is next to those of the other fragment."""
    return own[torch.cdist(own, others).amin(1).argmin()]


def _in_the_middle(nodes: Tensor, point: Tensor) -> Tensor:
    """The centre of the implant's cross-section at a point."""
    _, (*_, axis) = principal_axes(nodes)
    height = ((nodes - point) @ axis).abs()
    center = nodes[height <= height.sort().values[len(nodes) // 50 + 1] + 1e-9].mean(0)
    return center + ((point - center) @ axis) * axis

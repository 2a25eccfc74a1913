"""Implants on two rigid bone fragments: how their holds move, and the loads when one fragment moves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points

from .hexahedra import Hexahedra
from .holds import Hold, rigid_fields

_LEAST_RAD = 2e-3  # smaller rotations between screws are within their error
_MORE = 2.0  # so many times the rotation across the widest gap shows that the fracture is elsewhere


def hold_motions(hexahedra: Hexahedra, nodal: Tensor, holds: Sequence[Hold]) -> Tensor:
    """Translation and small rotation (A, U, 6) of U holds for nodal displacements (A, N, 3)."""
    positions = transform_points(hexahedra.frame, hexahedra.positions)
    motions = []
    for hold in holds:
        near = hold.nodes(positions)
        fields = rigid_fields(positions[near] - positions.new_tensor(hold.center))
        solution = torch.linalg.lstsq(fields.flatten(1).T, nodal[:, near].flatten(1).T.to(fields)).solution
        motions.append(solution.T)
    return torch.stack(motions, dim=1)


def rigid_at(center: Tensor) -> Tensor:
    """Translation and rotation (6, 6) at a point, for each of the six rigid motions about the origin."""
    identity = torch.eye(3, dtype=center.dtype, device=center.device)
    turning = torch.linalg.cross(identity, center.expand(3, 3)).T
    return torch.cat([torch.cat([identity, turning], dim=1), torch.cat([torch.zeros_like(identity), identity], dim=1)])


def fracture_among(heights: Tensor, turns: Tensor | None = None) -> float | None:
    """Height of the fracture among screws at heights (U,) along an implant; None for fewer than two.

    Screws of one fragment turn together. The fracture lies between those neighbours that turned most against each
    other, if that is a tenth of a degree and twice as much as across the widest gap; else in the widest gap.

    Args:
        heights: Heights of the screws.
        turns: Small rotation vectors (U, 3) of the implant around them; None if it is not bent.

    Example:
        >>> heights = torch.tensor([0.0, 30.0, 45.0, 60.0])
        >>> fracture_among(heights), fracture_among(heights, torch.tensor([[0.0], [0.0], [0.02], [0.02]]).expand(4, 3))
        (15.0, 37.5)
    """
    if len(heights) < 2:
        return None
    order = heights.argsort()
    heights = heights[order]
    place = widest = int(heights.diff().argmax())
    if turns is not None:
        between = turns[order].diff(dim=0).norm(dim=-1)
        most = int(between.argmax())
        if float(between[most]) > max(_MORE * float(between[widest]), _LEAST_RAD):
            place = most
    return float(heights[place] + heights[place + 1]) / 2


def sides_of_holds(centers: Tensor, axis: Tensor, used: list[int], turns: Tensor | None = None) -> Tensor:
    """Fragment of each hold (H,): -1 below and +1 above the fracture, 0 for holds without a screw.

    All are 0 with fewer than two used holds.

    Args:
        centers: Centres of the holds (H, 3).
        axis: Direction (3,) along the implant.
        used: Numbers of the holds that have a screw.
        turns: Small rotation vectors (U, 3) of these; None if the implant is not bent. See `fracture_among`.
    """
    heights = centers @ axis
    sides = torch.zeros(len(centers), dtype=torch.long, device="cpu")
    fracture = fracture_among(heights[used], turns)
    if fracture is not None:
        for hold in used:
            sides[hold] = 1 if float(heights[hold]) > fracture else -1
    return sides


def fragment_loads(loads: Tensor, energy: Tensor, centers: Tensor, sides: Tensor, scale: Tensor) -> Tensor:
    """Amounts (6, A + B) when the upper fragment exerts a unit force or moment along each axis on the lower one.

    Fragments are rigid, so that forces within a fragment do no work: of all loads with these resultants, those with the
    least elastic energy act (Castigliano's theorem of least work). Holds of no fragment carry nothing. Moments are
    about the middle between the fragments' holds.

    Args:
        loads: Forces (N) and moments (N mm) at the holds for an amount of one of each mode, (A + B, H, 6).
        energy: Second derivatives (A + B, A + B) of the elastic energy by the amounts, N mm.
        centers: Centres of the holds (H, 3).
        sides: Fragment of each hold (H,), -1, +1 or 0, see `sides_of_holds`.
        scale: Usual size (6,) of a force and a moment, N and N mm.
    """
    upper, lower, idle = ((sides == side).nonzero().flatten().to(loads.device) for side in (1, -1, 0))
    middle = (centers[upper].mean(0) + centers[lower].mean(0)) / 2
    forces, moments = loads[:, upper, :3], loads[:, upper, 3:]
    arms = (centers[upper] - middle).expand_as(forces)
    through = torch.cat([forces.sum(1), (moments + torch.linalg.cross(arms, forces)).sum(1)], dim=1)  # (A + B, 6)
    carried = (loads[:, idle] / scale).flatten(1)  # (A + B, 6 I)
    free = torch.eye(len(loads), dtype=loads.dtype, device=loads.device)
    if len(idle):
        left, sizes, _ = torch.linalg.svd(carried, full_matrices=True)
        free = left[:, int((sizes > 1e-9 * sizes.max()).sum()) :]
    stiffness = free.T @ energy @ free
    resultants = (through / scale).T @ free
    eased = torch.linalg.solve(stiffness, resultants.T)
    return (free @ eased @ torch.linalg.inv(resultants @ eased) / scale).T

"""Implants on two rigid bone fragments: how their holds move, and the loads when one fragment moves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points

from .hexahedra import Hexahedra
from .holds import Hold, rigid_fields


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


def sides_of_holds(centers: Tensor, axis: Tensor, used: list[int]) -> Tensor:
    """Fragment of each hold (H,): -1 below and +1 above the widest gap between used holds along the implant, 0 unused.

    All are 0 with fewer than two used holds.

    Args:
        centers: Centres of the holds (H, 3).
        axis: Direction (3,) along the implant.
        used: Numbers of the holds that have a screw.
    """
    heights = centers @ axis
    sides = torch.zeros(len(centers), dtype=torch.long, device="cpu")
    if len(used) < 2:
        return sides
    order = heights[used].sort().values
    widest = int(order.diff().argmax())
    middle = (order[widest] + order[widest + 1]) / 2
    for hold in used:
        sides[hold] = 1 if float(heights[hold]) > float(middle) else -1
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

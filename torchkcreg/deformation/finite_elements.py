"""Finite-element deformation: an implant bends elastically under unknown loads at the places where it is held."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import (
    ExpectedLoads,
    Hold,
    Superelement,
    hold_motions,
    shares_of_holds,
    sides_of_holds,
    used_holds,
)
from torchkcreg.mechanics.holds import rigid_fields

from .deformation import Deformation, Level, Motion
from .deviations import Deviations
from .linear import RigidMotion

_BEYOND_MM = 25.0


@torch.no_grad()
def bent_cloud(cloud: ImplantPointCloud, rest: Deformation) -> ImplantPointCloud:
    """Point cloud of an implant in its rest shape. Volumes stay the same, because plastic bending preserves volume."""
    return ImplantPointCloud(rest(cloud.points.double()).to(cloud.points), cloud.volumes, cloud.cell)


@torch.no_grad()
def bent_hold(hold: Hold, rest: Deformation) -> Hold:
    """A hold of an implant in its rest shape; the axis of a hole turns with the metal around it."""
    center = torch.tensor([hold.center], dtype=torch.float64, device="cpu")
    moved = tuple(rest(center)[0].tolist())
    if hold.axis is None:
        return replace(hold, center=moved)
    axis = rest.jacobian(center)[0] @ center.new_tensor(hold.axis)
    return replace(hold, center=moved, axis=tuple((axis / axis.norm()).tolist()))


@torch.no_grad()
def spread_of_rest(
    element: Superelement, rest: Deformation, deviations: Deviations, implant_to_world: Tensor
) -> Tensor:
    """Covariance (A, A), mm^2, of the apparent amounts caused by errors of the rest shape.

    If the rest shape is wrong, an unloaded implant seems to be bent by the opposite of the error. The apparent amounts
    are the regularised least-squares fit of the error fields, with the prior of the loads. A registered shape is
    counted as no more independent measurements than the body has sections.

    Args:
        element: Superelement of the implant in its rest shape.
        rest: Deformation from the undeformed implant to the rest shape.
        deviations: Uncertainty of the rest shape.
        implant_to_world: Pose (4, 4) in which the rest shape was registered.
    """
    fields = deviations.fields @ implant_to_world[:3, :3].to(deviations.fields)  # in the implant's axes
    if len(fields) == 0:
        return torch.zeros_like(element.expected.diag())
    nodes = rest(deviations.points.double())
    modes = element.linear(nodes, torch.eye(element.num_amounts, dtype=torch.float64, device=nodes.device))
    displacements = torch.cat([modes, rigid_fields(nodes - nodes.mean(0))]).flatten(1)
    variance = fields.square().sum() / (3 * len(element.sections.heights))  # per independent coordinate
    precision = torch.cat([element.expected.square().reciprocal(), nodes.new_zeros(6)]).diag()
    fit = torch.linalg.solve(
        displacements @ displacements.T + variance * precision, displacements @ fields.flatten(1).T
    )
    return fit[: element.num_amounts] @ fit[: element.num_amounts].T


class FiniteElementDeformation(Deformation):
    """Deformation of an elastic body under unknown loads at its holds.

    Strains are linear in the loads, but rotations are finite. The superelement gives the rotation and shift of each
    cross-section relative to its neighbour; these are integrated along the implant. The part of the linear
    displacements that is no motion of sections (distortion within a section, a few micrometres) is added.

    Args:
        superelement: Superelement of the implant.
        amounts: Amount (A,) of each of its bending modes, mm; zero if None.
        load_weight: Loss for a load of one standard deviation of the prior.
        weighed: If True, a registration estimates `load_weight` from the disagreement between its images.
        unused: Expected strength of loads at holds without a screw relative to holds with one, if screws are known.
        shares: Relative strength (H,) of the loads at each hold; all one if None.
        sides: Bone fragment of each hold (H,), -1, +1 or 0 for none, see `sides_of_holds`; all 0 if None.
        covariance: Covariance (A, A) of the amounts, mm^2, if a registration has estimated it.
        rest: Fixed deformation from the undeformed implant to its unloaded shape, which is the superelement's shape.
            If None, the unloaded shape is the undeformed implant.
        rest_spread: Covariance (A, A) of the amounts due to errors of the rest shape, see `spread_of_rest`.

    Attributes:
        amounts: Parameter (A,), float64.
        expected: Prior of the loads, in terms of the amounts.
    """

    model = "fe"
    weight: Tensor

    def __init__(
        self,
        superelement: Superelement,
        amounts: Tensor | None = None,
        *,
        load_weight: float = 1e-6,
        weighed: bool = False,
        unused: float = 1.0,
        shares: Tensor | None = None,
        sides: Sequence[int] | Tensor | None = None,
        covariance: Tensor | None = None,
        rest: Deformation | None = None,
        rest_spread: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.rest, self.rest_spread = None if rest is None else rest.requires_grad_(False), rest_spread
        self.superelement, self.unused, self.covariance = superelement, unused, covariance
        self.weighed = weighed
        weight = torch.tensor(load_weight, dtype=torch.float64, device=superelement.expected.device)
        self.register_buffer("weight", weight)  # a buffer, so that checkpoints keep an estimated weight
        self.shares = superelement.expected.new_ones(len(superelement.holds)) if shares is None else shares
        self.sides = (0,) * len(superelement.holds) if sides is None else tuple(int(side) for side in sides)
        self.expected = ExpectedLoads.of(superelement, self.shares, self.sides)
        start = torch.zeros_like(superelement.expected) if amounts is None else amounts.detach().clone()
        self.amounts = nn.Parameter(start.to(superelement.expected))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> FiniteElementDeformation:
        super()._apply(fn, recurse)
        self.amounts.data, self.weight = self.amounts.data.double(), self.weight.double()
        self.superelement = self.superelement.to(self.amounts.device)
        self.shares = self.shares.to(self.amounts.device)
        self.expected = ExpectedLoads.of(self.superelement, self.shares, self.sides)
        for name in ("covariance", "rest_spread"):
            if (covariance := getattr(self, name)) is not None:
                setattr(self, name, covariance.to(self.amounts.device))
        return self

    @property
    def load_weight(self) -> float:
        """Loss for a load of one standard deviation of the prior."""
        return float(self.weight)

    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame."""
        flat, element = points.reshape(-1, 3).double(), self.superelement
        rested = self.rested(flat)
        moved = section_features(element, rested) @ section_coefficients(element, self.amounts[None])[0]
        moved = moved + element.remainder(rested, self.amounts[None])[0] + (rested - flat)
        return moved.reshape(points.shape).to(points)

    def rested(self, points: Tensor) -> Tensor:
        """Positions of points (..., 3) of the undeformed implant in its rest shape (without load)."""
        return points if self.rest is None else self.rest(points)

    def motion(self, cloud: ImplantPointCloud, level: Level) -> Motion:
        """Rotation and translation of the whole implant, and as many of its softest bending modes as the level allows.

        A level of G groups has 6 G parameters, one of m modes has m.
        """
        if level.is_rigid:
            return RigidMotion(self, cloud)
        num_parameters = level.modes if level.modes is not None else RigidMotion.num_parameters * level.groups
        free = min(num_parameters - RigidMotion.num_parameters, self.superelement.num_amounts)
        return FiniteElementMotion(self, cloud, free)

    def strained(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) at points (..., N, 3) relative to the rest shape."""
        whole = self.jacobian(points)
        return whole if self.rest is None else whole @ torch.linalg.inv(self.rest.jacobian(points))

    def fixed_at(self, heads: Tensor) -> None:
        """Expect lower loads at holds without a screw, and those between the fragments next to the gap.

        See `torchkcreg.mechanics.shares_of_holds` and `sides_of_holds`.
        """
        heads = self.rested(heads)
        self.shares = shares_of_holds(self.superelement, heads, self.unused)
        element, amounts = self.superelement, self.amounts.detach()
        used, turns = used_holds(element, heads), None
        if used and bool(amounts.any()):
            motions = hold_motions(element.hexahedra, element.nodal, [element.holds[hold] for hold in used])
            turns = torch.einsum("a,aui->ui", amounts, motions[..., 3:].to(amounts))
        self.sides = tuple(sides_of_holds(element.centers, element.sections.axis, used, turns).tolist())
        self.expected = ExpectedLoads.of(self.superelement, self.shares, self.sides)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) well beyond the implant's ends: there the end sections' motion is extrapolated."""
        sections = self.superelement.sections
        height = self.rested(points.double()) @ sections.axis
        return (height < sections.heights[0] - _BEYOND_MM) | (height > sections.heights[-1] + _BEYOND_MM)

    def prior(self, amounts: Tensor) -> Tensor:
        """Weighted prior of the loads at the holds for amounts (K, A), shape (K,), in units of the loss."""
        return self.weight * torch.einsum("ka,ab,kb->k", amounts, self.expected.precision, amounts)

    @torch.no_grad()
    def surprise(self) -> float:
        """Mean square of the loads, in standard deviations of the prior."""
        return float(self.amounts @ self.expected.precision @ self.amounts) / len(self.amounts)

    @property
    def loads(self) -> Tensor:
        """Force and moment at each hold, (H, 6), N and N mm, in the implant's axes."""
        return torch.einsum("a,ahk->hk", self.amounts.detach(), self.expected.loads_of(self.superelement))

    @torch.no_grad()
    def reset(self) -> None:
        """Remove all loads; the rest shape stays."""
        self.amounts.zero_()

    def to_dict(self) -> dict[str, Any]:
        """Superelement, amounts and rest shape."""
        content: dict[str, Any] = {
            "model": self.model,
            "amounts": self.amounts.detach().cpu(),
            "covariance": None if self.covariance is None else self.covariance.cpu(),
            "load_weight": self.load_weight,
            "unused": self.unused,
            "shares": self.shares.cpu(),
            "sides": list(self.sides),
            "superelement": self.superelement.to("cpu").to_dict(),
        }
        return content if self.rest is None else content | {"rest": self.rest.to_dict()}


class FiniteElementMotion(Motion):
    """Rotation and translation of the whole implant, and steps along its softest bending modes, all in mm.

    The softest modes are those with the largest expected amounts under the prior of the loads.

    Args:
        deformation: Deformation from which the motion starts.
        cloud: The implant; rotations are about its centre of mass.
        num_free: Number of free bending modes.
    """

    def __init__(self, deformation: FiniteElementDeformation, cloud: ImplantPointCloud, num_free: int) -> None:
        self.deformation, self.num_free = deformation, num_free
        self.start = deformation.amounts.detach().clone()
        self.precisions, modes = torch.linalg.eigh(deformation.expected.precision)
        self.all_ways, self.ways = modes, modes[:, :num_free]
        self.whole = RigidMotion(deformation, cloud)
        self.num_parameters = self.whole.num_parameters + num_free

    @property
    def loss_of_deviation(self) -> float:  # type: ignore[override]
        """Weight of the prior of the loads."""
        return self.deformation.load_weight

    def weigh(self, loss: float) -> None:
        """Set the weight of the prior to the given loss, if the weight is to be estimated."""
        if self.deformation.weighed:
            self.deformation.weight.fill_(loss)

    def features(self, points: Tensor) -> Tensor:
        """Features of the sections (4 S), remainder of each mode (3 A), then the displacement to the rest shape (3)."""
        points, element = points.double(), self.deformation.superelement
        with torch.no_grad():
            rested = self.deformation.rested(points)
        remainder = element.remainder(rested, torch.eye(element.num_amounts, dtype=points.dtype, device=points.device))
        return torch.cat(
            [section_features(element, rested), remainder.permute(1, 0, 2).flatten(1), rested - points], dim=-1
        )

    def coefficients(self, steps: Tensor) -> Tensor:
        """Motions of the sections, then the amounts, all rotated and shifted with the whole implant."""
        steps = steps.double()
        amounts, (turn, shift) = self._amounts(steps), self.whole.turn_and_shift(steps)
        center = self.whole.center.to(turn)
        shift = center + shift - (turn @ center[:, None])[..., 0]
        sections = section_coefficients(self.deformation.superelement, amounts, turn, shift)
        modes = (amounts[..., None, None] * turn[:, None].mT).flatten(1, 2)
        identity = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return torch.cat([sections, modes, identity], dim=1)

    def penalty(self, steps: Tensor) -> Tensor:
        """Weighted prior of the loads."""
        return self.deformation.prior(self._amounts(steps))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """Store the amounts in the deformation and return the rotation and translation (4, 4)."""
        self.deformation.amounts.copy_(self._amounts(steps[None])[0])
        return self.whole.accept(steps[:6])

    def keep_covariance(self, covariance: Tensor) -> None:
        """Store the covariance of the amounts, including errors of the rest shape.

        Modes that were not free have the covariance of the prior.
        """
        first = self.whole.num_parameters
        total = torch.diag(1 / self.precisions)
        total[: self.num_free, : self.num_free] = covariance[first:, first:].to(total)
        spread = self.deformation.rest_spread
        total = self.all_ways @ total @ self.all_ways.T
        self.deformation.covariance = total if spread is None else total + spread.to(total)

    def _amounts(self, steps: Tensor) -> Tensor:
        return self.start.to(steps) + steps[:, self.whole.num_parameters :] @ self.ways.T.to(steps)


def section_features(superelement: Superelement, points: Tensor) -> Tensor:
    """Features (N, 4 S) of points (N, 3) for S sections: the weights, then weights times offsets from the centres."""
    weights = superelement.sections.weights(points)
    arms = (points[:, None] - superelement.sections.centers) * weights[..., None]
    return torch.cat([weights, arms.flatten(1)], dim=-1)


def section_coefficients(
    superelement: Superelement, amounts: Tensor, turn: Tensor | None = None, shift: Tensor | None = None
) -> Tensor:
    """Shifts t and rotations R - I of the sections, (K, 4 S, 3), for amounts (K, A).

    Args:
        superelement: Superelement of the implant.
        amounts: Amounts (K, A) of its bending modes, mm.
        turn: Rotations (K, 3, 3) of the whole implant.
        shift: Translations (K, 3) applied after the rotations, mm.
    """
    sections, amounts = superelement.sections, amounts.double()
    rotations, places = sections.chained(
        torch.einsum("ka,asi->ksi", amounts, superelement.shifts),
        torch.einsum("ka,asi->ksi", amounts, superelement.turns),
    )
    if turn is not None:
        places, rotations = (turn[:, None] @ places[..., None])[..., 0], turn[:, None] @ rotations
    if shift is not None:
        places = places + shift[:, None]
    identity = torch.eye(3, dtype=amounts.dtype, device=amounts.device)
    return torch.cat([places - sections.centers, (rotations.mT - identity).flatten(1, 2)], dim=1)

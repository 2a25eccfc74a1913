"""An implant that bends as its shape and alloy let it, under loads where it may be held."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import ExpectedLoads, Hold, Superelement, shares_of_holds
from torchkcreg.mechanics.holds import rigid_fields

from .deformation import Deformation, Level, Motion
from .deviations import Deviations
from .linear import RigidMotion

_BEYOND_MM = 25.0


@torch.no_grad()
def bent_cloud(cloud: ImplantPointCloud, rest: Deformation) -> ImplantPointCloud:
    """An implant in its rest shape; bent metal keeps its volume (what yields does not shrink)."""
    return ImplantPointCloud(rest(cloud.points.double()).to(cloud.points), cloud.volumes, cloud.cell)


@torch.no_grad()
def bent_hold(hold: Hold, rest: Deformation) -> Hold:
    """A hold of an implant in its rest shape: a hole's axis turns with the metal about it."""
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
    """Covariance (A, A), mm^2, of the amounts that are mistaken for loads because the rest shape may be off.

    Where the rest shape is off, an implant without load seems to be bent by as much the other way: by those amounts
    that fit its deviations best beside the prior of the loads. Of what a registration knows of a shape, no more than
    the sections of the body is independent.

    Args:
        element: Of the implant in its rest shape.
        rest: From the undeformed implant to that.
        deviations: By which it may be off.
        implant_to_world: Pose (4, 4) in which it was registered.
    """
    fields = deviations.fields @ implant_to_world[:3, :3].to(deviations.fields)  # in the implant's axes
    if len(fields) == 0:
        return torch.zeros_like(element.expected.diag())
    nodes = rest(deviations.points.double())
    ways = element.linear(nodes, torch.eye(element.num_amounts, dtype=torch.float64, device=nodes.device))
    moves = torch.cat([ways, rigid_fields(nodes - nodes.mean(0))]).flatten(1)
    variance = fields.square().sum() / (3 * len(element.sections.heights))  # a coordinate's, for that many places
    precision = torch.cat([element.expected.square().reciprocal(), nodes.new_zeros(6)]).diag()
    found = torch.linalg.solve(moves @ moves.T + variance * precision, moves @ fields.flatten(1).T)
    return found[: element.num_amounts] @ found[: element.num_amounts].T


class FiniteElementDeformation(Deformation):
    """Displacements of an elastic body whose loads at its holds are unknown.

    Strains are linear in the loads, rotations finite: sections along the implant turn and shift against their
    neighbours as the superelement says, which is integrated along it, and what of the linear displacements is no motion
    of sections (a section's own distortion, a few micrometres) is added.

    Args:
        superelement: Of the implant.
        amounts: Of each of its ways to bend, mm; zero when None.
        load_weight: Loss for a load that is a standard deviation of the prior.
        weighed: A registration finds that weight, by what its images disagree about.
        unused: How strong loads are at holds without a screw, against those with one, where screws are known.
        shares: That of each hold, (H,); one when None.
        covariance: Of the amounts, (A, A), mm^2, where a registration has found it.
        rest: From the undeformed implant to the shape that loads bend, which is the superelement's; the undeformed one
            when None. It stays as it is.
        rest_spread: Covariance of amounts that are none but errors of the rest shape, see `spread_of_rest`.

    Attributes:
        amounts: Parameter (A,), float64.
        expected: Of the loads.
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
        covariance: Tensor | None = None,
        rest: Deformation | None = None,
        rest_spread: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.rest, self.rest_spread = None if rest is None else rest.requires_grad_(False), rest_spread
        self.superelement, self.unused, self.covariance = superelement, unused, covariance
        self.weighed = weighed
        weight = torch.tensor(load_weight, dtype=torch.float64, device=superelement.expected.device)
        self.register_buffer("weight", weight)  # part of the state: a checkpoint keeps what was found
        self.shares = superelement.expected.new_ones(len(superelement.holds)) if shares is None else shares
        self.expected = ExpectedLoads.of(superelement, self.shares)
        start = torch.zeros_like(superelement.expected) if amounts is None else amounts.detach().clone()
        self.amounts = nn.Parameter(start.to(superelement.expected))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> FiniteElementDeformation:
        super()._apply(fn, recurse)
        self.amounts.data, self.weight = self.amounts.data.double(), self.weight.double()
        self.superelement = self.superelement.to(self.amounts.device)
        self.shares = self.shares.to(self.amounts.device)
        self.expected = ExpectedLoads.of(self.superelement, self.shares)
        for name in ("covariance", "rest_spread"):
            if (known := getattr(self, name)) is not None:
                setattr(self, name, known.to(self.amounts.device))
        return self

    @property
    def load_weight(self) -> float:
        """Loss for a load that is a standard deviation of the prior."""
        return float(self.weight)

    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame."""
        flat, element = points.reshape(-1, 3).double(), self.superelement
        rested = self.rested(flat)
        moved = section_features(element, rested) @ section_coefficients(element, self.amounts[None])[0]
        moved = moved + element.remainder(rested, self.amounts[None])[0] + (rested - flat)
        return moved.reshape(points.shape).to(points)

    def rested(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the undeformed implant's frame where they are without load."""
        return points if self.rest is None else self.rest(points)

    def motion(self, cloud: ImplantPointCloud, level: Level) -> Motion:
        """Rotation and translation of the whole, and as many of the softest ways to bend as the level allows.

        G groups have 6 G numbers to move by, m modes m of them.
        """
        if level.is_rigid:
            return RigidMotion(self, cloud)
        wanted = level.modes if level.modes is not None else RigidMotion.num_parameters * level.groups
        free = min(wanted - RigidMotion.num_parameters, self.superelement.num_amounts)
        return FiniteElementMotion(self, cloud, free)

    def strained(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) at points (..., N, 3) against the rest shape."""
        whole = self.jacobian(points)
        return whole if self.rest is None else whole @ torch.linalg.inv(self.rest.jacobian(points))

    def fixed_at(self, heads: Tensor) -> None:
        """Holds without a screw carry less from now on, see :func:`torchkcreg.mechanics.shares_of_holds`."""
        self.shares = shares_of_holds(self.superelement, self.rested(heads), self.unused)
        self.expected = ExpectedLoads.of(self.superelement, self.shares)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) well beyond the implant's ends, where its end sections' motion goes on."""
        sections = self.superelement.sections
        height = self.rested(points.double()) @ sections.axis
        return (height < sections.heights[0] - _BEYOND_MM) | (height > sections.heights[-1] + _BEYOND_MM)

    def prior(self, amounts: Tensor) -> Tensor:
        """What speaks against amounts (K, A) but the images, shape (K,): how strong the loads at the holds are."""
        return self.weight * torch.einsum("ka,ab,kb->k", amounts, self.expected.precision, amounts)

    @torch.no_grad()
    def surprise(self) -> float:
        """Mean square of the loads in standard deviations of the prior."""
        return float(self.amounts @ self.expected.precision @ self.amounts) / len(self.amounts)

    @property
    def loads(self) -> Tensor:
        """Force and moment at each hold, (H, 6), N and N mm, in the implant's axes."""
        return torch.einsum("a,ahk->hk", self.amounts.detach(), self.expected.loads_of(self.superelement))

    @torch.no_grad()
    def reset(self) -> None:
        """Takes all loads away; what was bent before stays so."""
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
            "superelement": self.superelement.to("cpu").to_dict(),
        }
        return content if self.rest is None else content | {"rest": self.rest.to_dict()}


class FiniteElementMotion(Motion):
    """Rotation and translation of the whole implant, and steps along the softest ways to bend, all in mm.

    Softest under the loads that are expected.

    Args:
        deformation: Where the motion starts.
        cloud: The implant; its middle is what it turns about.
        num_free: Along how many ways it may bend.
    """

    def __init__(self, deformation: FiniteElementDeformation, cloud: ImplantPointCloud, num_free: int) -> None:
        self.deformation, self.num_free = deformation, num_free
        self.start = deformation.amounts.detach().clone()
        self.precisions, ways = torch.linalg.eigh(deformation.expected.precision)
        self.all_ways, self.ways = ways, ways[:, :num_free]
        self.whole = RigidMotion(deformation, cloud)
        self.num_parameters = self.whole.num_parameters + num_free

    @property
    def loss_of_deviation(self) -> float:  # type: ignore[override]
        """The prior's weight."""
        return self.deformation.load_weight

    def weigh(self, loss: float) -> None:
        """The prior counts as it should, if its weight is to be found."""
        if self.deformation.weighed:
            self.deformation.weight.fill_(loss)

    def features(self, points: Tensor) -> Tensor:
        """Those of the sections (4 S), then each way's remainder (3 A), then how far points had moved without load."""
        points, element = points.double(), self.deformation.superelement
        with torch.no_grad():
            rested = self.deformation.rested(points)
        left = element.remainder(rested, torch.eye(element.num_amounts, dtype=points.dtype, device=points.device))
        return torch.cat([section_features(element, rested), left.permute(1, 0, 2).flatten(1), rested - points], dim=-1)

    def coefficients(self, steps: Tensor) -> Tensor:
        """Motions of the sections, then amounts, turned and shifted as a whole."""
        steps = steps.double()
        amounts, (turn, shift) = self._amounts(steps), self.whole.turn_and_shift(steps)
        center = self.whole.center.to(turn)
        shift = center + shift - (turn @ center[:, None])[..., 0]
        sections = section_coefficients(self.deformation.superelement, amounts, turn, shift)
        left = (amounts[..., None, None] * turn[:, None].mT).flatten(1, 2)
        same = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return torch.cat([sections, left, same], dim=1)

    def penalty(self, steps: Tensor) -> Tensor:
        """The deformation's prior."""
        return self.deformation.prior(self._amounts(steps))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """The rotation and translation; the amounts have gone into the deformation."""
        self.deformation.amounts.copy_(self._amounts(steps[None])[0])
        return self.whole.accept(steps[:6])

    def keep_covariance(self, covariance: Tensor) -> None:
        """That of the amounts, rest shape included; those that were not free have what the prior expects."""
        free = self.whole.num_parameters
        whole = torch.diag(1 / self.precisions)
        whole[: self.num_free, : self.num_free] = covariance[free:, free:].to(whole)
        spread = self.deformation.rest_spread
        whole = self.all_ways @ whole @ self.all_ways.T
        self.deformation.covariance = whole if spread is None else whole + spread.to(whole)

    def _amounts(self, steps: Tensor) -> Tensor:
        return self.start.to(steps) + steps[:, self.whole.num_parameters :] @ self.ways.T.to(steps)


def section_features(superelement: Superelement, points: Tensor) -> Tensor:
    """What points (N, 3) need to know of S sections, (N, 4 S): their weights, and these times the arms from them."""
    weights = superelement.sections.weights(points)
    arms = (points[:, None] - superelement.sections.centers) * weights[..., None]
    return torch.cat([weights, arms.flatten(1)], dim=-1)


def section_coefficients(
    superelement: Superelement, amounts: Tensor, turn: Tensor | None = None, shift: Tensor | None = None
) -> Tensor:
    """Shifts and rotations less one of the sections, (K, 4 S, 3), for amounts (K, A).

    Args:
        superelement: Of the implant.
        amounts: Of its ways to bend.
        turn: Rotations (K, 3, 3) of the whole.
        shift: Translations (K, 3) after them.
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
    same = torch.eye(3, dtype=amounts.dtype, device=amounts.device)
    return torch.cat([places - sections.centers, (rotations.mT - same).flatten(1, 2)], dim=1)

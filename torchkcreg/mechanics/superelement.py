"""An elastic implant condensed to the loads at its holds: a few dozen ways to bend, softest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants
from torchkcreg.plain import require_keys

from .body import ElasticBody
from .hexahedra import Hexahedra, interpolated
from .holds import Hold, unit_loads
from .sections import Sections
from .stress import StressField

_STATIONS = 24
_NUMBERS = ("filled", "loads", "expected", "stiff", "shifts", "turns")
_PITCH_MM = 0.5  # of nodes that tell the motion of a section


@dataclass(frozen=True)
class LoadPrior:
    """How strong loads at a hold are expected to be, standard deviations.

    Attributes:
        force: Along each axis, N.
        moment: About each axis, N mm.
    """

    force: float = 200.0
    moment: float = 1500.0


@dataclass(frozen=True, eq=False)
class Superelement:
    """Ways in which an implant bends under loads at its holds that are in balance.

    Static condensation: each way is the response to loads at the holds, so all between them is free. Ways are
    independent under the prior of loads, and ordered by how far they then move the implant.

    Attributes:
        hexahedra: That carry displacements.
        filled: Volume of metal in each, (E,), mm^3.
        constants: Of the alloy.
        holds: The H places.
        sections: Along the implant.
        loads: Forces and moments at the holds of each way at an amount of one, (A, H, 6), N and N mm, in the implant's
            axes. An amount of one moves the implant by 1 mm, root mean square.
        expected: Amounts (A,) that the prior expects, standard deviations, mm.
        prior: How strong those are.
        stiff: Loads (B, H, 6), of one standard deviation, that move the implant less than images can tell.
        nodal: Displacements (A, N, 3) of the hexahedra's nodes at an amount of one, mm.
        shifts: Of the sections, (A, S, 3), mm.
        turns: Of the sections, (A, S, 3), radians.
    """

    hexahedra: Hexahedra
    filled: Tensor
    constants: ElasticConstants
    holds: tuple[Hold, ...]
    sections: Sections
    loads: Tensor
    expected: Tensor
    prior: LoadPrior
    stiff: Tensor
    nodal: Tensor
    shifts: Tensor
    turns: Tensor

    @classmethod
    def of(
        cls,
        cloud: ImplantPointCloud,
        constants: ElasticConstants,
        holds: Sequence[Hold],
        *,
        prior: LoadPrior | None = None,
        negligible_mm: float = 1e-3,
    ) -> Superelement:
        """Of an implant and where it may be held.

        Args:
            cloud: The implant.
            constants: Of its alloy.
            holds: At least two.
            prior: Of the loads.
            negligible_mm: Ways that the prior expects to move the implant less are left out.

        Raises:
            ValueError: If there are fewer than two holds: no loads could be in balance.
        """
        if len(holds) < 2:
            raise ValueError(f"an implant that bends is held in two places or more, got {len(holds)}")
        prior = prior or LoadPrior()
        body = ElasticBody(cloud, constants)
        units = body.response(*unit_loads(cloud, holds))
        scale = units.new_tensor([prior.force] * 3 + [prior.moment] * 3).repeat(len(holds))
        balanced = _balanced(holds, scale)  # (6 H - 6, 6 H), orthonormal under the prior
        coarse = cloud.coarsened_to(_PITCH_MM)
        points, volumes = coarse.points.double(), coarse.volumes.double()
        moved = body.displacement(points, units)
        flat = (moved * (volumes / volumes.sum()).sqrt()[:, None]).flatten(1)
        mapped = balanced * scale
        values, vectors = torch.linalg.eigh(mapped @ (flat @ flat.T) @ mapped.T)
        values, ways = values.flip(0).clamp_min(0).sqrt(), vectors.flip(1).T @ mapped
        ways = ways * _senses(ways @ moved.flatten(1))
        kept = int((values > negligible_mm).sum().clamp_min(1))
        ways, stiff, expected = ways[:kept] / values[:kept, None], ways[kept:], values[:kept]
        sections = Sections.along(coarse, _STATIONS)
        shifts, turns = sections.motions(points, volumes, torch.einsum("al,lni->ani", ways, moved))
        return cls(
            body.hexahedra,
            body.filled,
            constants,
            tuple(holds),
            sections,
            ways.unflatten(-1, (-1, 6)),
            expected,
            prior,
            stiff.unflatten(-1, (-1, 6)),
            torch.einsum("al,lni->ani", ways, units).float().double(),  # as files keep them
            shifts,
            turns,
        )

    @property
    def num_amounts(self) -> int:
        """A."""
        return len(self.expected)

    def remainder(self, points: Tensor, amounts: Tensor) -> Tensor:
        """What of linear displacements (K, P, 3) at points (P, 3) the motion of the sections leaves, mm.

        Points beside the implant have that of the nearest cube's edge.

        Args:
            points: In the implant's frame.
            amounts: Shape (K, A).
        """
        points, amounts = points.double(), amounts.to(self.nodal)
        there, whole = self._interpolated(points, amounts)
        shifts, turns = (torch.einsum("ka,asi->ksi", amounts, ways) for ways in (self.shifts, self.turns))
        return whole - self.sections.blended(there, shifts, turns)

    def linear(self, points: Tensor, amounts: Tensor) -> Tensor:
        """Linear displacements (K, P, 3) for amounts (K, A) at points (P, 3), mm; beside it, of the nearest edge."""
        return self._interpolated(points.double(), amounts.to(self.nodal))[1]

    def _interpolated(self, points: Tensor, amounts: Tensor) -> tuple[Tensor, Tensor]:
        """The places (P, 3) in the cubes nearest to points, and the linear displacements (K, P, 3) there."""
        cube, inside = self.hexahedra.locate(points)
        held = inside.clamp(-1, 1)
        there = points + (held - inside) @ self.hexahedra.frame[:3, :3].mT * (self.hexahedra.edge / 2)
        nodal = torch.einsum("ka,ani->kni", amounts, self.nodal)
        return there, interpolated(self.hexahedra, nodal, cube, held)

    def stress(self, points: Tensor, amounts: Tensor) -> Tensor:
        """Stresses (P, 3, 3) at points (P, 3) of the undeformed implant, N/mm^2, in its axes."""
        nodal = torch.einsum("a,ani->ni", amounts.to(self.nodal), self.nodal)[None]
        return StressField.of(self.hexahedra, self.filled, self.constants, nodal).at(points)[0]

    def to(self, device: torch.device | str) -> Superelement:
        """On a device."""
        moved = {f.name: _moved(getattr(self, f.name), device) for f in fields(self)}
        return replace(self, **moved)

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors; displacements in single precision."""
        cubes, sections = self.hexahedra, self.sections
        return {
            "hexahedra": {"frame": cubes.frame, "edge": cubes.edge, "cells": cubes.cells},
            "constants": asdict(self.constants),
            "prior": asdict(self.prior),
            "holds": [asdict(hold) for hold in self.holds],
            "sections": {"axis": sections.axis, "heights": sections.heights, "centers": sections.centers},
            **{name: getattr(self, name) for name in _NUMBERS},
            "nodal": self.nodal.float(),
        }

    @classmethod
    def from_dict(cls, content: Any) -> Superelement:
        """What :meth:`to_dict` gave.

        Raises:
            ValueError: A key is missing or malformed; the message names it.
        """
        parts = ("hexahedra", "constants", "prior", "holds", "sections")
        require_keys(content, (*parts, *_NUMBERS, "nodal"), " of a superelement")
        try:
            cubes = content["hexahedra"]
            return cls(
                Hexahedra.of_cells(_numbers(cubes["frame"]), float(cubes["edge"]), _numbers(cubes["cells"]).long()),
                constants=ElasticConstants(**content["constants"]),
                prior=LoadPrior(**content["prior"]),
                holds=tuple(Hold(**_with_tuples(hold)) for hold in content["holds"]),
                sections=Sections(**{name: _numbers(value) for name, value in content["sections"].items()}),
                nodal=_numbers(content["nodal"]),
                **{name: _numbers(content[name]) for name in _NUMBERS},
            )
        except (TypeError, KeyError) as error:
            raise ValueError(f"the superelement is malformed: {error}") from None


def _numbers(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device="cpu")


def _with_tuples(content: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}


def _senses(displacements: Tensor) -> Tensor:
    """1 or -1 (A, 1) for each of displacements (A, N): where it is largest it shall be positive.

    Eigenvectors have no sense of their own, and libraries and processors give them one or the other. Of equal ones, as
    the ends of a symmetric implant have, a later one counts as larger.
    """
    rising = torch.linspace(1.0, 1.01, displacements.shape[1], dtype=displacements.dtype, device=displacements.device)
    largest = (displacements.abs() * rising).argmax(1, keepdim=True)
    return 1.0 - 2.0 * (displacements.gather(1, largest) < 0)


def _balanced(holds: Sequence[Hold], scale: Tensor) -> Tensor:
    """Orthonormal combinations (6 H - 6, 6 H) of scaled loads at holds whose force and moment vanish."""
    places = scale.new_tensor([h.center for h in holds])
    places = (places - places.mean(0)).to(scale)
    same = torch.eye(3, dtype=scale.dtype, device=scale.device)
    rows = []
    for place in places:
        arm = torch.linalg.cross(place.expand(3, 3), same)  # moments of unit forces there, one a row
        forces = torch.cat([same, torch.zeros_like(same)], dim=1)
        rows.append(torch.cat([forces, torch.cat([arm.mT, same], dim=1)]))
    balance = torch.cat(rows, dim=1) * scale  # (6, 6 H)
    _, _, right = torch.linalg.svd(balance / balance.norm(dim=1, keepdim=True), full_matrices=True)
    return right[6:]


def _moved(part: Any, device: torch.device | str) -> Any:
    if isinstance(part, Tensor):
        return part.to(device)
    if isinstance(part, (Hexahedra, Sections)):
        return replace(part, **{f.name: _moved(getattr(part, f.name), device) for f in fields(part)})
    return part


@dataclass(frozen=True, eq=False)
class ExpectedLoads:
    """A prior of loads, some holds of which carry less than others, in terms of a superelement's amounts.

    Attributes:
        precision: Of the amounts, (A, A), 1/mm^2: ``a^T precision a`` is the least sum of squared loads, in standard
            deviations, that bends the implant by amounts a.
        followed: Of the stiff ways, (B, A): how much of them comes with an amount.
        spread: Covariance (B, B) of the stiff ways about that.
    """

    precision: Tensor
    followed: Tensor
    spread: Tensor

    @classmethod
    def of(cls, element: Superelement, shares: Tensor | None = None) -> ExpectedLoads:
        """Of an implant.

        Args:
            element: The implant.
            shares: How strong loads of each hold are against what the superelement's prior expects, (H,); all of them
                that when None.
        """
        number = element.num_amounts
        scale = element.loads.new_tensor([element.prior.force] * 3 + [element.prior.moment] * 3)
        strengths = scale.expand(len(element.holds), 6) * (1.0 if shares is None else shares.to(scale)[:, None])
        ways = (torch.cat([element.loads, element.stiff]) / strengths).flatten(1)
        whole = ways @ ways.T
        stiff, mixed = whole[number:, number:], whole[number:, :number]
        spread = torch.linalg.inv(stiff)
        followed = -spread @ mixed
        return cls(whole[:number, :number] + mixed.T @ followed, followed, spread)

    def loads_of(self, element: Superelement) -> Tensor:
        """Loads (A, H, 6) that are likeliest at an amount of one, those of the stiff ways included, N and N mm."""
        return element.loads + torch.einsum("ba,bhk->ahk", self.followed, element.stiff)

    @property
    def covariance(self) -> Tensor:
        """Of the amounts that are expected, (A, A), mm^2."""
        return torch.linalg.inv(self.precision)


def shares_of_holds(element: Superelement, heads: Sequence[Tensor] | Tensor, unused: float) -> Tensor:
    """Shares (H,) of holds where an implant is fixed: one at the nearest hold of each head (C, 3), else less.

    All are one where heads are at fewer than two holds: no loads could be in balance.
    """
    centers = element.loads.new_tensor([hold.center for hold in element.holds])
    used = {int((centers - head.to(centers)).norm(dim=-1).argmin()) for head in heads}
    if len(used) < 2:
        return torch.ones_like(centers[:, 0])
    return centers.new_tensor([1.0 if hold in used else unused for hold in range(len(centers))])

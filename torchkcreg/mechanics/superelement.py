"""Superelement: an elastic implant condensed to the loads at its holds, with a few dozen bending modes, softest first.

Also the prior of these loads.
"""

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
from .rigid_fragments import fragment_loads
from .sections import Sections
from .stress import StressField

_STATIONS = 24
_NUMBERS = ("filled", "loads", "expected", "stiff", "shifts", "turns")
# Load between two fragments over that of a hold, standard deviations: 500 N, most of a body's weight, and 15 N m, half
# of what bends a plate for good.
_THROUGH_FORCE, _THROUGH_MOMENT = 2.5, 10.0
_PITCH_MM = 0.5  # node spacing from which the motion of a section is computed


@dataclass(frozen=True)
class LoadPrior:
    """Standard deviations of the loads expected at a hold.

    Attributes:
        force: Force along each axis, N.
        moment: Moment about each axis, N mm.
    """

    force: float = 200.0
    moment: float = 1500.0


@dataclass(frozen=True, eq=False)
class Superelement:
    """Bending modes of an implant under loads in equilibrium at its holds.

    Static condensation: each mode is the response to loads at the holds, and no load acts between them. The modes are
    independent under the prior of the loads, and ordered by their expected displacement of the implant.

    Attributes:
        hexahedra: Hexahedra whose nodes carry the displacements.
        filled: Volume of metal in each, (E,), mm^3.
        constants: Elastic constants of the alloy.
        holds: The H holds.
        sections: Cross-sections along the implant.
        loads: Forces and moments at the holds for an amount of one of each mode, (A, H, 6), N and N mm, in the
            implant's axes. An amount of one moves the implant by 1 mm, root mean square.
        expected: Standard deviations (A,) of the amounts under the prior, mm.
        prior: Prior of the loads at the holds.
        stiff: Stiff modes: loads (B, H, 6) of one standard deviation that move the implant less than is visible in
            images.
        nodal: Displacements (A, N, 3) of the hexahedra's nodes for an amount of one, mm.
        shifts: Shifts (A, S, 3) of the sections for an amount of one, mm.
        turns: Small rotation vectors (A, S, 3) of the sections for an amount of one, radians.
        energy: Second derivatives (A + B, A + B) of the elastic energy by the amounts, stiff modes last, N mm; None in
            files of earlier versions.
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
    energy: Tensor | None = None

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
        """Superelement of an implant and its holds.

        Args:
            cloud: The implant.
            constants: Elastic constants of its alloy.
            holds: At least two holds.
            prior: Prior of the loads; default values if None.
            negligible_mm: Modes with a smaller expected displacement are counted as stiff modes.

        Raises:
            ValueError: If there are fewer than two holds, since no loads could then be in equilibrium.
        """
        if len(holds) < 2:
            raise ValueError(f"an implant that bends is held in two places or more, got {len(holds)}")
        prior = prior or LoadPrior()
        body = ElasticBody(cloud, constants)
        places, forces = unit_loads(cloud, holds)
        unit_responses = body.response(places, forces)
        scale = unit_responses.new_tensor([prior.force] * 3 + [prior.moment] * 3).repeat(len(holds))
        balanced = _balanced(holds, scale)  # (6 H - 6, 6 H), orthonormal under the prior
        coarse = cloud.coarsened_to(_PITCH_MM)
        points, volumes = coarse.points.double(), coarse.volumes.double()
        moved = body.displacement(points, unit_responses)
        flat = (moved * (volumes / volumes.sum()).sqrt()[:, None]).flatten(1)
        mapped = balanced * scale
        values, vectors = torch.linalg.eigh(mapped @ (flat @ flat.T) @ mapped.T)
        values, modes = values.flip(0).clamp_min(0).sqrt(), vectors.flip(1).T @ mapped
        modes = modes * _senses(modes @ moved.flatten(1))
        work = _work(body, places, forces, unit_responses)
        num_modes = int((values > negligible_mm).sum().clamp_min(1))
        modes, stiff, expected = modes[:num_modes] / values[:num_modes, None], modes[num_modes:], values[:num_modes]
        sections = Sections.along(coarse, _STATIONS)
        shifts, turns = sections.motions(points, volumes, torch.einsum("al,lni->ani", modes, moved))
        return cls(
            body.hexahedra,
            body.filled,
            constants,
            tuple(holds),
            sections,
            modes.unflatten(-1, (-1, 6)),
            expected,
            prior,
            stiff.unflatten(-1, (-1, 6)),
            torch.einsum("al,lni->ani", modes, unit_responses).float().double(),  # single precision, as in files
            shifts,
            turns,
            torch.cat([modes, stiff]) @ work @ torch.cat([modes, stiff]).T,
        )

    @property
    def num_amounts(self) -> int:
        """Number of modes A."""
        return len(self.expected)

    @property
    def centers(self) -> Tensor:
        """Centres of the holds (H, 3), mm."""
        return self.loads.new_tensor([hold.center for hold in self.holds])

    def remainder(self, points: Tensor, amounts: Tensor) -> Tensor:
        """Linear displacements (K, P, 3) at points (P, 3) minus the motion of the sections, mm.

        Points outside all cubes get the value at the nearest cube's surface.

        Args:
            points: Points in the implant's frame.
            amounts: Amounts of the modes, shape (K, A), mm.
        """
        points, amounts = points.double(), amounts.to(self.nodal)
        places, linear = self._interpolated(points, amounts)
        shifts, turns = (torch.einsum("ka,asi->ksi", amounts, motions) for motions in (self.shifts, self.turns))
        return linear - self.sections.blended(places, shifts, turns)

    def linear(self, points: Tensor, amounts: Tensor) -> Tensor:
        """Linear displacements (K, P, 3) for amounts (K, A) at points (P, 3), mm.

        Points outside all cubes get the value at the nearest cube's surface.
        """
        return self._interpolated(points.double(), amounts.to(self.nodal))[1]

    def _interpolated(self, points: Tensor, amounts: Tensor) -> tuple[Tensor, Tensor]:
        """Points (P, 3) moved to the nearest place inside their cubes, and the linear displacements (K, P, 3) there."""
        cube, inside = self.hexahedra.locate(points)
        clamped = inside.clamp(-1, 1)
        places = points + (clamped - inside) @ self.hexahedra.frame[:3, :3].mT * (self.hexahedra.edge / 2)
        nodal = torch.einsum("ka,ani->kni", amounts, self.nodal)
        return places, interpolated(self.hexahedra, nodal, cube, clamped)

    def stress(self, points: Tensor, amounts: Tensor) -> Tensor:
        """Stresses (P, 3, 3) for amounts (A,) at points (P, 3) of the undeformed implant, N/mm^2, in its axes."""
        nodal = torch.einsum("a,ani->ni", amounts.to(self.nodal), self.nodal)[None]
        return StressField.of(self.hexahedra, self.filled, self.constants, nodal).at(points)[0]

    def to(self, device: torch.device | str) -> Superelement:
        """Copy on a device."""
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
            **({} if self.energy is None else {"energy": self.energy}),
            "nodal": self.nodal.float(),
        }

    @classmethod
    def from_dict(cls, content: Any) -> Superelement:
        """Inverse of `to_dict`.

        Raises:
            ValueError: If a key is missing or malformed; the message names it.
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
                energy=_numbers(content["energy"]) if "energy" in content else None,
                **{name: _numbers(content[name]) for name in _NUMBERS},
            )
        except (TypeError, KeyError) as error:
            raise ValueError(f"the superelement is malformed: {error}") from None


def _work(body: ElasticBody, places: Sequence[Tensor], forces: Sequence[Tensor], responses: Tensor) -> Tensor:
    """Work (L, L) of each of L unit loads, forces (P, 3) at places (P, 3), on the responses (L, N, 3) to the others."""
    rows = []
    for hold in range(0, len(places), 6):  # the six loads of a hold act at the same places
        moved = body.displacement(places[hold], responses)
        rows += [torch.einsum("pi,lpi->l", force, moved) for force in forces[hold : hold + 6]]
    work = torch.stack(rows)
    return 0.5 * (work + work.T)


def _numbers(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device="cpu")


def _with_tuples(content: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}


def _senses(displacements: Tensor) -> Tensor:
    """Signs (A, 1) that make the largest component of each row of displacements (A, N) positive.

    The sign of an eigenvector is arbitrary and differs between libraries and processors. Among equally large components
    (as at the ends of a symmetric implant) a later one counts as larger.
    """
    rising = torch.linspace(1.0, 1.01, displacements.shape[1], dtype=displacements.dtype, device=displacements.device)
    largest = (displacements.abs() * rising).argmax(1, keepdim=True)
    return 1.0 - 2.0 * (displacements.gather(1, largest) < 0)


def _balanced(holds: Sequence[Hold], scale: Tensor) -> Tensor:
    """Orthonormal combinations (6 H - 6, 6 H) of scaled loads at holds with zero resultant force and moment."""
    places = scale.new_tensor([h.center for h in holds])
    places = (places - places.mean(0)).to(scale)
    identity = torch.eye(3, dtype=scale.dtype, device=scale.device)
    rows = []
    for place in places:
        arm = torch.linalg.cross(place.expand(3, 3), identity)  # moments of unit forces there, in rows
        forces = torch.cat([identity, torch.zeros_like(identity)], dim=1)
        rows.append(torch.cat([forces, torch.cat([arm.mT, identity], dim=1)]))
    balance = torch.cat(rows, dim=1) * scale  # (6, 6 H)
    _, _, row_space = torch.linalg.svd(balance / balance.norm(dim=1, keepdim=True), full_matrices=True)
    return row_space[6:]


def _moved(part: Any, device: torch.device | str) -> Any:
    if isinstance(part, Tensor):
        return part.to(device)
    if isinstance(part, (Hexahedra, Sections)):
        return replace(part, **{f.name: _moved(getattr(part, f.name), device) for f in fields(part)})
    return part


@dataclass(frozen=True, eq=False)
class ExpectedLoads:
    """Prior of the loads in terms of a superelement's amounts; some holds may be expected to carry less than others.

    Attributes:
        precision: Precision (A, A) of the amounts, 1/mm^2: `a^T precision a` is the least sum of squared loads, in
            standard deviations, that bends the implant by amounts a.
        followed: Regression (B, A) of the stiff modes on the amounts: their expected amounts per unit amount.
        spread: Covariance (B, B) of the stiff modes given the amounts.
    """

    precision: Tensor
    followed: Tensor
    spread: Tensor

    @classmethod
    def of(
        cls, element: Superelement, shares: Tensor | None = None, sides: Sequence[int] | None = None
    ) -> ExpectedLoads:
        """Prior of the loads of an implant.

        Screws of a bone fragment move as one rigid body. Most of the load between two fragments goes therefore through
        the screws next to the gap, far more than screws carry on average. With `sides` the prior is wide for those
        loads, whatever it expects at single holds.

        Args:
            element: Superelement of the implant.
            shares: Strength (H,) of the loads at each hold relative to the superelement's prior; all one if None.
            sides: Fragment of each hold (H,), see `sides_of_holds`; None or all of one: no fragments.
        """
        num_amounts = element.num_amounts
        scale = element.loads.new_tensor([element.prior.force] * 3 + [element.prior.moment] * 3)
        strengths = scale.expand(len(element.holds), 6) * (1.0 if shares is None else shares.to(scale)[:, None])
        loads = torch.cat([element.loads, element.stiff])
        scaled_loads = (loads / strengths).flatten(1)
        gram = scaled_loads @ scaled_loads.T
        if sides is not None and element.energy is not None and {-1, 1} <= set(sides):
            where = torch.tensor(sides, device="cpu")
            through = scale * scale.new_tensor([_THROUGH_FORCE] * 3 + [_THROUGH_MOMENT] * 3)
            wide = fragment_loads(loads, element.energy, element.centers, where, scale) * through[:, None]
            weighted = gram @ wide.T  # Woodbury: inverse of gram^-1 + wide^T wide
            inner = torch.eye(6, dtype=gram.dtype, device=gram.device) + wide @ weighted
            gram = gram - weighted @ torch.linalg.solve(inner, weighted.T)
            gram = 0.5 * (gram + gram.T)
        stiff, mixed = gram[num_amounts:, num_amounts:], gram[num_amounts:, :num_amounts]
        spread = torch.linalg.inv(stiff)
        followed = -spread @ mixed
        return cls(gram[:num_amounts, :num_amounts] + mixed.T @ followed, followed, spread)

    def loads_of(self, element: Superelement) -> Tensor:
        """Most likely loads (A, H, 6) for an amount of one of each mode, including those of stiff modes, N and N mm."""
        return element.loads + torch.einsum("ba,bhk->ahk", self.followed, element.stiff)

    @property
    def covariance(self) -> Tensor:
        """Prior covariance (A, A) of the amounts, mm^2."""
        return torch.linalg.inv(self.precision)


def used_holds(element: Superelement, heads: Sequence[Tensor] | Tensor) -> list[int]:
    """Numbers of the holds nearest to each head (C, 3)."""
    centers = element.centers
    return sorted({int((centers - head.to(centers)).norm(dim=-1).argmin()) for head in heads})


def shares_of_holds(element: Superelement, heads: Sequence[Tensor] | Tensor, unused: float) -> Tensor:
    """Relative strength (H,) of the loads at each hold: one at the hold nearest to each head (C, 3), else `unused`.

    All are one if the heads are at fewer than two holds, since no loads could then be in equilibrium.
    """
    used, number = used_holds(element, heads), len(element.holds)
    if len(used) < 2:
        return element.loads.new_ones(number)
    return element.loads.new_tensor([1.0 if hold in used else unused for hold in range(number)])

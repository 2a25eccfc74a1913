"""What an implant carries: loads through its sections and at its holds, stresses, and how sure each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .sections import Sections
from .stress import StressField, deviator, von_mises
from .superelement import ExpectedLoads, Superelement

_SECTIONS = 121
_AT_ONCE = 1024
_COMPONENTS = ("across", "out of plane", "along")


@dataclass(frozen=True, eq=False)
class CarriedLoad:
    """Loads of an implant in its own axes: across it (its width), out of its plane (its thickness), along it.

    Attributes:
        axes: Unit vectors (3, 3) of the implant's frame, one a row: across, out of plane, along.
        holds: Names of the H places where it is held.
        hold_heights: Where they are along the implant, (H,), mm from its lower end.
        hold_loads: Force (N) and moment (N mm) there, (H, 6).
        hold_std: Standard deviations of them.
        heights: Of T sections, mm from its lower end.
        section_loads: What the part above a section puts on the part below: force through it (N) and moment about its
            middle (N mm), (T, 6). The moment about the first axis bends the implant out of its plane, that about the
            second in its plane, the third twists it.
        section_std: Standard deviations of them.
    """

    axes: Tensor
    holds: tuple[str, ...]
    hold_heights: Tensor
    hold_loads: Tensor
    hold_std: Tensor
    heights: Tensor
    section_loads: Tensor
    section_std: Tensor

    @classmethod
    def of(
        cls,
        element: Superelement,
        amounts: Tensor,
        covariance: Tensor | None = None,
        expected: ExpectedLoads | None = None,
    ) -> CarriedLoad:
        """Of amounts (A,) of an implant's ways to bend.

        Args:
            element: The implant.
            amounts: mm.
            covariance: Of them, (A, A), mm^2; without it nothing is known but what the prior expects.
            expected: Of its loads; that all holds are alike when None.
        """
        axes = _axes(element)
        expected = expected or ExpectedLoads.of(element)
        covariance = expected.covariance if covariance is None else covariance
        places = axes.new_tensor([hold.center for hold in element.holds])
        turned = torch.block_diag(axes, axes)
        loads, stiff = expected.loads_of(element) @ turned.mT, element.stiff @ turned.mT
        low, high = element.sections.heights[0], element.sections.heights[-1]
        heights = torch.linspace(0, 1, _SECTIONS, dtype=torch.float64, device=axes.device) * (high - low)
        through = _through(places @ axes.mT, _middles(element.sections, heights + low) @ axes.mT)

        def found(mapping: Tensor) -> tuple[Tensor, Tensor]:
            ways = torch.einsum("tkhl,ahl->tka", mapping, loads)
            rest = torch.einsum("tkhl,bhl->tkb", mapping, stiff)
            variance = torch.einsum("tka,ab,tkb->tk", ways, covariance, ways)
            variance = variance + torch.einsum("tka,ab,tkb->tk", rest, expected.spread, rest)
            return ways @ amounts, variance.clamp_min(0).sqrt()

        number = len(places)
        same = torch.eye(6 * number, dtype=torch.float64, device=axes.device).reshape(number, 6, number, 6)
        hold_heights = places @ element.sections.axis - low
        return cls(axes, tuple(h.name for h in element.holds), hold_heights, *found(same), heights, *found(through))

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, with units in their names."""

        def told(loads: Tensor, std: Tensor) -> dict[str, Any]:
            parts = {"force_n": loads[..., :3], "moment_nmm": loads[..., 3:]}
            return parts | {"force_std_n": std[..., :3], "moment_std_nmm": std[..., 3:]}

        holds = zip(self.holds, self.hold_heights.tolist(), self.hold_loads, self.hold_std, strict=True)
        return {
            "axes": {name: axis for name, axis in zip(_COMPONENTS, self.axes, strict=True)},
            "holds": [{"name": n, "height_mm": z, **told(loads, std)} for n, z, loads, std in holds],
            "sections": {"height_mm": self.heights, **told(self.section_loads, self.section_std)},
        }


def node_stresses(element: Superelement, points: Tensor, amounts: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Von Mises stress (P,) at points (P, 3) of the undeformed implant and its standard deviation, N/mm^2.

    Args:
        element: The implant.
        points: In its frame.
        amounts: Of its ways to bend, (A,), mm.
        covariance: Of them, (A, A), mm^2.
    """
    field = StressField.of(element.hexahedra, element.filled, element.constants, element.nodal)
    found, deviations = [], []
    for some in points.double().split(_AT_ONCE):
        ways = field.at(some)
        total = torch.einsum("a,apij->pij", amounts, ways)
        value = von_mises(total)
        slope = torch.einsum("pij,apij->pa", deviator(total), ways) * (1.5 / value.clamp_min(1e-9))[:, None]
        found.append(value)
        deviations.append(torch.einsum("pa,ab,pb->p", slope, covariance, slope).clamp_min(0).sqrt())
    return torch.cat(found), torch.cat(deviations)


def _axes(element: Superelement) -> Tensor:
    """Across, out of plane, along: the lattice's axes, its shortest one out of plane."""
    frame = element.hexahedra.frame[:3, :3].mT
    spread = element.hexahedra.positions.amax(0) - element.hexahedra.positions.amin(0)
    along = element.sections.axis
    rest = [frame[k] for k in spread.argsort().tolist() if abs(float(frame[k] @ along)) < 0.7]
    out = rest[0] - (rest[0] @ along) * along
    out = out / out.norm()
    return torch.stack([torch.linalg.cross(out, along), out, along])


def _middles(sections: Sections, heights: Tensor) -> Tensor:
    """Centres (T, 3) of the metal at heights, between those of the stations."""
    place = (heights - sections.heights[0]) / (sections.heights[1] - sections.heights[0])
    stations = torch.arange(len(sections.heights), dtype=place.dtype, device=place.device)
    weights = (1 - (place[:, None] - stations).abs()).clamp_min(0)
    middles = weights @ sections.centers
    return middles + (heights - middles @ sections.axis)[:, None] * sections.axis


def _through(places: Tensor, middles: Tensor) -> Tensor:
    """Maps (T, 6, H, 6) from loads at places (H, 3) to what goes through sections with middles (T, 3)."""
    same = torch.eye(3, dtype=places.dtype, device=places.device)
    arms = places - middles[:, None]  # (T, H, 3)
    turning = torch.linalg.cross(arms[..., None, :].expand(-1, -1, 3, -1), same.expand(*arms.shape[:2], 3, 3), dim=-1)
    mapping = places.new_zeros(len(middles), 6, len(places), 6)
    above = (arms[..., 2] > 0).to(places)
    mapping[:, :3, :, :3] = torch.einsum("th,kl->tkhl", above, same)
    mapping[:, 3:, :, 3:] = torch.einsum("th,kl->tkhl", above, same)
    mapping[:, 3:, :, :3] = torch.einsum("th,thlk->tkhl", above, turning)
    return mapping

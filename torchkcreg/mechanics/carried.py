"""Loads that an implant carries at its holds and through its sections, von Mises stresses, and their uncertainty."""

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
    """Loads of an implant in its own axes: across (width), out of plane (thickness), along (length).

    Attributes:
        axes: Unit vectors (3, 3) in the implant's frame, in rows: across, out of plane, along.
        holds: Names of the H holds.
        hold_heights: Positions (H,) of the holds along the implant, mm from its lower end.
        hold_loads: Force (N) and moment (N mm) at each hold, (H, 6).
        hold_std: Standard deviations of `hold_loads`.
        heights: Positions (T,) of T sections, mm from the lower end.
        section_loads: Internal loads (T, 6) that the part above a section exerts on the part below: force (N) and
            moment about the section's centre (N mm). The moment about the first axis bends the implant out of its
            plane, the one about the second axis bends it in its plane, and the one about the third twists it.
        section_std: Standard deviations of `section_loads`.
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
        """Loads for amounts (A,) of an implant's bending modes.

        Args:
            element: Superelement of the implant.
            amounts: Amounts (A,) of its bending modes, mm.
            covariance: Covariance (A, A) of the amounts, mm^2; that of the prior if None.
            expected: Prior of the loads; if None, all holds are equally strong.
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

        def with_deviation(mapping: Tensor) -> tuple[Tensor, Tensor]:
            per_mode = torch.einsum("tkhl,ahl->tka", mapping, loads)
            per_stiff_mode = torch.einsum("tkhl,bhl->tkb", mapping, stiff)
            variance = torch.einsum("tka,ab,tkb->tk", per_mode, covariance, per_mode)
            variance = variance + torch.einsum("tka,ab,tkb->tk", per_stiff_mode, expected.spread, per_stiff_mode)
            return per_mode @ amounts, variance.clamp_min(0).sqrt()

        num_holds = len(places)
        identity = torch.eye(6 * num_holds, dtype=torch.float64, device=axes.device).reshape(num_holds, 6, num_holds, 6)
        hold_heights = places @ element.sections.axis - low
        return cls(
            axes,
            tuple(h.name for h in element.holds),
            hold_heights,
            *with_deviation(identity),
            heights,
            *with_deviation(through),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, with units in the keys."""

        def with_units(loads: Tensor, std: Tensor) -> dict[str, Any]:
            parts = {"force_n": loads[..., :3], "moment_nmm": loads[..., 3:]}
            return parts | {"force_std_n": std[..., :3], "moment_std_nmm": std[..., 3:]}

        holds = zip(self.holds, self.hold_heights.tolist(), self.hold_loads, self.hold_std, strict=True)
        return {
            "axes": {name: axis for name, axis in zip(_COMPONENTS, self.axes, strict=True)},
            "holds": [{"name": n, "height_mm": z, **with_units(loads, std)} for n, z, loads, std in holds],
            "sections": {"height_mm": self.heights, **with_units(self.section_loads, self.section_std)},
        }


def node_stresses(element: Superelement, points: Tensor, amounts: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Von Mises stress (P,) at points (P, 3) of the undeformed implant, and its standard deviation, N/mm^2.

    Args:
        element: Superelement of the implant.
        points: Points in the implant's frame.
        amounts: Amounts (A,) of its bending modes, mm.
        covariance: Covariance (A, A) of the amounts, mm^2.
    """
    field = StressField.of(element.hexahedra, element.filled, element.constants, element.nodal)
    stresses, deviations = [], []
    for chunk in points.double().split(_AT_ONCE):
        modes = field.at(chunk)
        total = torch.einsum("a,apij->pij", amounts, modes)
        value = von_mises(total)
        slope = torch.einsum("pij,apij->pa", deviator(total), modes) * (1.5 / value.clamp_min(1e-9))[:, None]
        stresses.append(value)
        deviations.append(torch.einsum("pa,ab,pb->p", slope, covariance, slope).clamp_min(0).sqrt())
    return torch.cat(stresses), torch.cat(deviations)


def _axes(element: Superelement) -> Tensor:
    """Axes (3, 3) across, out of plane, along the implant: those of the lattice, the shortest one out of plane."""
    frame = element.hexahedra.frame[:3, :3].mT
    spread = element.hexahedra.positions.amax(0) - element.hexahedra.positions.amin(0)
    along = element.sections.axis
    across_axes = [frame[k] for k in spread.argsort().tolist() if abs(float(frame[k] @ along)) < 0.7]
    out = across_axes[0] - (across_axes[0] @ along) * along
    out = out / out.norm()
    return torch.stack([torch.linalg.cross(out, along), out, along])


def _middles(sections: Sections, heights: Tensor) -> Tensor:
    """Centres (T, 3) of the metal at heights (T,), interpolated between those of the stations."""
    place = (heights - sections.heights[0]) / (sections.heights[1] - sections.heights[0])
    stations = torch.arange(len(sections.heights), dtype=place.dtype, device=place.device)
    weights = (1 - (place[:, None] - stations).abs()).clamp_min(0)
    middles = weights @ sections.centers
    return middles + (heights - middles @ sections.axis)[:, None] * sections.axis


def _through(places: Tensor, middles: Tensor) -> Tensor:
    """Matrices (T, 6, H, 6) from loads at places (H, 3) to internal loads of sections with centres (T, 3)."""
    identity = torch.eye(3, dtype=places.dtype, device=places.device)
    arms = places - middles[:, None]  # (T, H, 3)
    turning = torch.linalg.cross(
        arms[..., None, :].expand(-1, -1, 3, -1), identity.expand(*arms.shape[:2], 3, 3), dim=-1
    )
    mapping = places.new_zeros(len(middles), 6, len(places), 6)
    above = (arms[..., 2] > 0).to(places)
    mapping[:, :3, :, :3] = torch.einsum("th,kl->tkhl", above, identity)
    mapping[:, 3:, :, 3:] = torch.einsum("th,kl->tkhl", above, identity)
    mapping[:, 3:, :, :3] = torch.einsum("th,thlk->tkhl", above, turning)
    return mapping

"""Stiffness of the tissue in a fracture's gap, from the load that bypasses the implant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_INNER = 0.6  # inner over outer radius of a long bone's cortex
_SPREAD = (1 + _INNER**2) / 4  # I / A of a ring over its outer radius squared


@dataclass(frozen=True)
class GapLoad:
    """A loaded fracture as seen in its bending plane, each with its standard deviation.

    Attributes:
        force: Force (N) along the bone, towards the lower fragment; known.
        moment: Moment (N mm) that bends the implant out of its plane at the gap; positive closes the far cortex.
        moment_std: Its standard deviation.
        closing: How far the gap closes at the bone's axis, mm.
        closing_std: Its standard deviation.
        turn: Angle (radians) of the upper fragment in that sense.
        turn_std: Its standard deviation.
    """

    force: float
    moment: float
    moment_std: float
    closing: float
    closing_std: float
    turn: float
    turn_std: float


@dataclass(frozen=True)
class CallusStiffness:
    """Stiffness of the tissue in the gap.

    Attributes:
        axial: N/mm.
        axial_std: Its standard deviation.
        bending: N m per degree.
        bending_std: Its standard deviation.
        shares: Share of the force that goes through the tissue under each load.
        shares_std: Standard deviations of these.
    """

    axial: float
    axial_std: float
    bending: float
    bending_std: float
    shares: tuple[float, ...]
    shares_std: tuple[float, ...]

    @property
    def contradicts(self) -> bool:
        """True if the stiffness is negative beyond two standard deviations: the model of two springs does not hold."""
        return self.axial < -2 * self.axial_std

    def to_dict(self) -> dict[str, Any]:
        """The numbers with units in the keys."""
        return {
            "axial_n_per_mm": self.axial,
            "axial_std_n_per_mm": self.axial_std,
            "bending_nm_per_deg": self.bending,
            "bending_std_nm_per_deg": self.bending_std,
            "shares_of_load": list(self.shares),
            "shares_of_load_std": list(self.shares_std),
        }


def callus_stiffness(loads: Sequence[GapLoad], lever_mm: float, radius_mm: float) -> CallusStiffness:
    """Stiffness of the tissue in the gap, by a model of two springs: the implant, and a column of tissue.

    The force F acts along the bone's axis, at a distance d from the implant. The tissue is an elastic column as wide as
    the cortex: of axial stiffness k, its bending stiffness is k I / A with I / A of a ring. Moments of the upper
    fragment about the bone's axis at the gap balance: with the implant's moment M, the gap's closing c and the
    fragment's turn t,

        M + k (I / A) t = d (F - k c).

    Without tissue the implant carries d F. Errors of the measured loads are taken as independent, the force and the
    geometry as exact.

    Args:
        loads: One or more loads.
        lever_mm: Distance d of the implant's centre from the bone's axis.
        radius_mm: Outer radius of the bone.

    Raises:
        ValueError: If there is no load, or nothing moves, so that no stiffness follows.

    Example:
        >>> no_tissue = GapLoad(600, 600 * 18, 300, 0.5, 0.05, 0.03, 0.001)
        >>> callus_stiffness([no_tissue], 18.0, 13.0).axial
        0.0
    """
    spread = _SPREAD * radius_mm**2
    missing = [lever_mm * load.force - load.moment for load in loads]  # moment that the implant does not carry
    per_stiffness = [spread * load.turn + lever_mm * load.closing for load in loads]
    weights = [1 / max(load.moment_std, 1e-9) ** 2 for load in loads]
    scale = sum(w * p * p for w, p in zip(weights, per_stiffness, strict=True))
    if not loads or not scale > 0:
        raise ValueError("the fracture does not move under load, so that no stiffness of the gap follows")
    axial = sum(w * m * p for w, m, p in zip(weights, missing, per_stiffness, strict=True)) / scale
    variances = [
        load.moment_std**2 + axial**2 * ((spread * load.turn_std) ** 2 + (lever_mm * load.closing_std) ** 2)
        for load in loads
    ]
    std = math.sqrt(sum((w * p) ** 2 * v for w, p, v in zip(weights, per_stiffness, variances, strict=True))) / scale
    bend = spread * math.radians(1) / 1000  # N m per degree over N/mm
    shares = tuple(axial * load.closing / load.force for load in loads)
    shares_std = tuple(math.hypot(std * load.closing, axial * load.closing_std) / load.force for load in loads)
    return CallusStiffness(axial, std, axial * bend, std * bend, shares, shares_std)

"""The answer of a visit: motion of the fracture, load through the implant and stress of each scan under load."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.evaluation import BONE_PLACES, CallusStiffness, GapLoad, RelativeMotion, callus_stiffness
from torchkcreg.geometry import fit_rigid
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import CarriedLoad
from torchkcreg.registration import RegisteredImplant

from .load import ImplantLoad

TURN_KEYS = ("bending_out_of_plane", "bending_in_plane", "twist")  # about the axes of a `RelativeMotion`


@dataclass(frozen=True, eq=False)
class LoadedConfiguration:
    """One scan under load against the unloaded one.

    Attributes:
        name: Name of the scan.
        status: "ok", "doubtful" or "failed".
        reasons: Why it is not ok.
        load_n: Applied load; None if unknown.
        motion: Motion of the upper fragment relative to the lower one; None if it failed.
        place: Name of the point whose translation leads.
        carried: Loads and stresses; None if the alloy's stiffness is unknown.
        gap_load: Force (N) and moment (N mm) through the implant at the gap in the motion's axes (6,), and their
            standard deviations (6,); None without loads.
    """

    name: str
    status: str
    reasons: tuple[str, ...]
    load_n: float | None = None
    motion: RelativeMotion | None = None
    place: str = "gap"
    carried: ImplantLoad | None = None
    gap_load: tuple[Tensor, Tensor] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The numbers, with units in the keys."""
        content: dict[str, Any] = {"name": self.name, "status": self.status, "reasons": list(self.reasons)}
        if self.load_n is not None:
            content["load_n"] = self.load_n
        motion = self.motion
        if motion is None:
            return content
        content["rotation_deg"], content["rotation_std_deg"] = motion.angle_deg.tolist()
        content["translation_mm"], content["translation_std_mm"] = motion.lengths_mm[0].tolist()
        if self.gap_load is not None:
            content["moment_nmm"], content["moment_std_nmm"] = _length(*(part[3:] for part in self.gap_load))
            content["force_n"], content["force_std_n"] = _length(*(part[:3] for part in self.gap_load))
        turns = motion.rotation_deg.tolist(), motion.rotation_std_deg.tolist()
        for key, value, std in zip(TURN_KEYS, *turns, strict=True):
            content[f"{key}_deg"], content[f"{key}_std_deg"] = value, std
        content["places"] = dict(zip((self.place, *BONE_PLACES), self._places(), strict=False))
        if self.gap_load is not None:
            moments = (part[3:].tolist() for part in self.gap_load)
            for key, value, std in zip(TURN_KEYS, *moments, strict=True):
                content[f"{key}_moment_nmm"], content[f"{key}_moment_std_nmm"] = value, std
        if self.carried is not None:
            share, share_std = self.stress_share
            content |= {"stress_mpa": self.carried.stress, "stress_std_mpa": self.carried.stress_std}
            content |= {"share_of_yield": share, "share_of_yield_std": share_std}
        content["motion"] = motion.to_dict()
        return content

    def _places(self) -> list[dict[str, Any]]:
        motion = self.motion
        assert motion is not None
        return [
            {
                "at_mm": at.tolist(),
                "translation_mm": length[0].item(),
                "translation_std_mm": length[1].item(),
                "axial_mm": moved[2].item(),
                "axial_std_mm": std[2].item(),
                "shear_mm": moved[:2].norm().item(),
                "shear_std_mm": _length(moved[:2], std[:2])[1],
            }
            for at, moved, std, length in zip(
                motion.places, motion.places_mm, motion.places_std_mm, motion.lengths_mm, strict=True
            )
        ]

    @property
    def stress_share(self) -> tuple[float, float]:
        """Largest stress over the yield stress, and its standard deviation."""
        assert self.carried is not None
        return self.carried.stress / self.carried.yield_stress, self.carried.stress_std / self.carried.yield_stress

    def sentence(self) -> str:
        """The answer in a sentence."""
        under = f"Under {self.load_n:g} N" if self.load_n is not None else f"In {self.name}"
        if self.motion is None:
            return f"{under} nothing was measured: {'; '.join(self.reasons)}."
        turn, turn_std = self.motion.angle_deg.tolist()
        parts = [f"{under} the upper fragment tilts by {_pm(turn, turn_std)} degrees"]
        if len(self.motion.places) > 2:
            axial, std = float(self.motion.places_mm[2, 2]), float(self.motion.places_std_mm[2, 2])
            parts.append(
                f"the gap {'closes' if axial < 0 else 'opens'} by {_pm(abs(axial), std)} mm at the bone's axis"
            )
        else:
            length, std = self.motion.lengths_mm[0].tolist()
            parts.append(f"it moves by {_pm(length, std)} mm at the {self.place}")
        if self.gap_load is not None and self.carried is not None:
            value, std = _length(*(part[3:] for part in self.gap_load))
            share, share_std = self.stress_share
            parts.append(
                f"the implant carries {_pm(value / 1000, std / 1000)} N m across it and reaches "
                f"{_pm(100 * share, 100 * share_std)} % of its yield stress"
            )
        return "; ".join(parts) + "."


@dataclass(frozen=True, eq=False)
class Assessment:
    """The answer of a visit.

    Attributes:
        unloaded: Name of the unloaded scan.
        configurations: Each scan under load against the unloaded one.
        assumed: What was assumed, a line each.
        warnings: What to doubt, a line each.
        commands: Commands that repeat each step.
        mineral: Bone mineral of regions of the unloaded scan; empty without volumes.
        callus: Stiffness of the tissue in the gap; None without known forces, stiffness of the alloy, or screws.
        folder: Output folder.
    """

    unloaded: str
    configurations: tuple[LoadedConfiguration, ...]
    assumed: tuple[str, ...]
    warnings: tuple[str, ...]
    commands: tuple[str, ...]
    mineral: tuple[dict[str, Any], ...] = ()
    callus: CallusStiffness | None = None
    folder: Path = field(default=Path())

    def to_dict(self) -> dict[str, Any]:
        """Content of `assess.json`."""
        return {
            "unloaded": self.unloaded,
            "answer": [configuration.sentence() for configuration in self.configurations],
            "configurations": [configuration.to_dict() for configuration in self.configurations],
            "assumed": list(self.assumed),
            "warnings": list(self.warnings),
            "commands": list(self.commands),
            "mineral": list(self.mineral),
            **({} if self.callus is None else {"callus": self.callus.to_dict()}),
        }

    def __str__(self) -> str:
        lines = [f"{c.sentence()} ({c.status})" for c in self.configurations]
        lines += [f"doubt: {c.name}: {reason}" for c in self.configurations for reason in c.reasons]
        if self.callus is not None:
            axial, bending = self.callus.axial, self.callus.bending
            lines.append(
                f"the tissue in the gap has a stiffness of {_pm(axial, self.callus.axial_std)} N/mm and "
                f"{_pm(bending, self.callus.bending_std)} N m/degree"
            )
        lines += [
            f"{m['region']}: {m['hydroxyapatite_mg_ml']:.0f} mg/mL of hydroxyapatite in {m['volume_ml']:.2f} mL"
            for m in self.mineral
        ]
        lines += [f"assumed: {text}" for text in self.assumed]
        return "\n".join([*lines, *(f"doubt: {text}" for text in self.warnings), f"folder {self.folder}"])


def load_at(
    carried: CarriedLoad, place: Tensor, motion: RelativeMotion, first: RegisteredImplant, cloud: ImplantPointCloud
) -> tuple[Tensor, Tensor]:
    """Force (N) and moment (N mm) that the upper part exerts on the lower one at a place's height, (6,), and their std.

    Args:
        carried: Loads of the implant.
        place: Point (3,) in the implant's frame.
        motion: Its axes are used.
        first: Registration without load.
        cloud: The undeformed implant.
    """
    low = (cloud.points.double() @ carried.axes[2]).min()
    height = (place @ carried.axes[2] - low).clamp(carried.heights[0], carried.heights[-1])
    step = carried.heights[1] - carried.heights[0]
    position = (height / step).clamp(0, len(carried.heights) - 1 - 1e-6)
    below, share = int(position), position - int(position)
    value, variance = (
        (1 - share) * values[below] + share * values[below + 1]
        for values in (carried.section_loads, carried.section_std.square())
    )
    nodes = cloud.points.double()
    turn = motion.axes @ fit_rigid(nodes, first.warp(nodes))[:3, :3] @ carried.axes.mT
    turn = turn if float(turn[2, 2]) > 0 else -turn  # above is below
    both = torch.block_diag(turn, turn)
    return both @ value, (both.square() @ variance).sqrt()


def callus_of(
    configurations: Sequence[LoadedConfiguration], gap: Tensor, bone: Tensor, axes: Tensor
) -> CallusStiffness | None:
    """Stiffness of the tissue in the gap; None if no configuration has a known force, a motion and a load.

    Args:
        configurations: The scans under load.
        gap: Point (3,) of the gap at the implant.
        bone: Near cortex, axis and far cortex (3, 3) there.
        axes: The motion's axes in the same frame, as rows (3, 3).
    """
    loads = []
    for c in configurations:
        if c.load_n is None or c.motion is None or c.gap_load is None:
            continue
        (moment, std), motion = c.gap_load, c.motion
        turn, turn_std = (torch.deg2rad(x[0]).item() for x in (motion.rotation_deg, motion.rotation_std_deg))
        closing, closing_std = -motion.places_mm[2, 2].item(), motion.places_std_mm[2, 2].item()
        loads.append(GapLoad(c.load_n, moment[3].item(), std[3].item(), closing, closing_std, turn, turn_std))
    if not loads:
        return None
    lever = float((gap - bone[1]) @ axes[1])
    try:
        return callus_stiffness(loads, lever, 0.5 * float((bone[2] - bone[0]).norm()))
    except ValueError:
        return None


def _length(vector: Tensor, std: Tensor) -> tuple[float, float]:
    """Length of a vector and its standard deviation, components taken as independent."""
    length = vector.norm()
    along = vector / length if float(length) > 0 else torch.full_like(vector, len(vector) ** -0.5)
    return float(length), float((along * std).norm())


def _pm(value: float, std: float) -> str:
    """A value and its standard deviation with two significant digits of the latter.

    >>> _pm(2.0512, 0.0634)
    '2.051 +- 0.063'
    """
    if not math.isfinite(std) or std <= 0:
        return f"{value:.3g}"
    digits = max(0, 1 - math.floor(math.log10(std)))
    return f"{value:.{digits}f} +- {std:.{digits}f}"

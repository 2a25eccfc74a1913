"""The paper's settings of a registration, and departures from them, one at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchkcreg.registration import Stage, preset_stages
from torchkcreg.registration.config import PHYSICS

PAPER = "paper's settings"


@dataclass(frozen=True)
class Settings:
    """Settings of a registration.

    Attributes:
        options: Options of the registration.
        screws: Give the screws to the registration.
        spectrum: Give the spectrum to the registration.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    screws: bool = False
    spectrum: bool = False


def departures(material: str) -> dict[str, Settings]:
    """The paper's settings, then each with one change.

    Args:
        material: Name of the implant's material, for polyenergetic DRRs.
    """
    paper, physical = {"preset": "paper"}, {"preset": "paper", "material": material}
    start, *others = preset_stages("paper")
    slid = [start.model_copy(update={"after": ("slide",)}), *others]
    estimated = [start, others[0], *(_with_background(stage) for stage in others[1:])]
    return {
        PAPER: Settings(paper),
        "screws as components": Settings(paper, screws=True),
        "polyenergetic DRRs": Settings(physical, spectrum=True),
        "screws and polyenergetic DRRs": Settings(physical, screws=True, spectrum=True),
        "both, background and physics estimated": Settings(
            {**physical, "stages": _written(estimated)}, screws=True, spectrum=True
        ),
        "elastic energy in the objective": Settings({**paper, "stiffness": 30.0}),
        "control points 17.5 mm apart, as many as needed": Settings(
            {**paper, "grid_spacing_mm": (8.75, 8.75, 17.5), "grid_grows": True}
        ),
        "places along the plate compared": Settings({**paper, "stages": _written(slid)}),
        "implausible stages undone": Settings({**paper, "undo_stages": True}),
    }


def _with_background(stage: Stage) -> Stage:
    return stage.model_copy(update={"before": ("background",), "estimate": PHYSICS})


def _written(stages: list[Stage]) -> list[dict[str, Any]]:
    return [stage.model_dump() for stage in stages]

"""Where else an implant fits: plates with holes at even distances fit nearly as well one hole further."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .objective import StageObjective

_STEP_MM = 2.0  # a coarse image's optimum is a few mm wide
_WORSE = 1.5  # times the least loss: what fits no better is no candidate
_MOST = 3


@dataclass(frozen=True)
class Rival:
    """The second best of the places that were tried.

    Attributes:
        distance_mm: Root mean square distance of the implant's nodes there from where they fit best.
        misfit: What is left unexplained of the images there.
        best_misfit: What is left where they fit best.
    """

    distance_mm: float
    misfit: float
    best_misfit: float


@torch.no_grad()
def places(objective: StageObjective, found: Tensor) -> list[Tensor]:
    """Parameters (D,) of a rigid stage from which the registration is worth trying, that found first.

    Others are where the loss has a minimum along the implant's long axis, up to half its length away, and the start,
    where the stage left it by more than a few steps: coarse pixels may prefer another place without seeing the holes.

    Args:
        objective: Of a stage of one group.
        found: Where the stage ended, shape (D,).
    """
    points = objective.model.elasticity.points
    extent = float((points.amax(0) - points.amin(0)).norm())
    steps = int(0.5 * extent / _STEP_MM)
    shifts = _STEP_MM * torch.arange(-steps, steps + 1, dtype=torch.float64)
    along = found.repeat(len(shifts), 1)
    along[:, _long_axis(objective)] += shifts
    losses = objective.losses(along)
    padded = torch.nn.functional.pad(losses[None], (1, 1), value=torch.inf)[0]
    minimum = (losses < padded[:-2]) & (losses <= padded[2:]) & (losses <= _WORSE * losses.min())
    minimum[steps - 1 : steps + 2] = False  # that is where it is
    order = losses.argsort()
    others = [along[i] for i in order.tolist() if minimum[i]][: _MOST - 1]
    start = torch.zeros_like(found)
    if _distance(objective, found, start) > 3 * _STEP_MM:
        others.append(start)
    return [found, *others]


def _distance(objective: StageObjective, one: Tensor, other: Tensor) -> float:
    """Root mean square distance of the implant's nodes, mm."""
    moved = objective.model.elasticity.displacements(objective.model.motion_steps(torch.stack([one, other])))
    return float((moved[0] - moved[1]).norm())


def _long_axis(objective: StageObjective) -> int:
    """Which parameter of the one group shifts the implant along its longest extent."""
    grid = objective.scene.deformation.grid
    spread = objective.model.elasticity.points.double() @ grid.frame[:3, :3].to(torch.float64)
    return 3 + int((spread.amax(0) - spread.amin(0)).argmax())

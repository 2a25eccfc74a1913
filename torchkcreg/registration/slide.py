"""A look along the implant: plates with holes at even distances fit nearly as well one hole further."""

from __future__ import annotations

import torch
from torch import Tensor

from .objective import StageObjective

_STEP_MM = 2.0  # a coarse image's optimum is a few mm wide


def slid(objective: StageObjective, parameters: Tensor) -> Tensor | None:
    """Parameters (D,) of a rigid stage moved to where the loss is least along the implant's long axis.

    All places up to half the implant's length away are looked at in one batch. None where no other is better.

    Args:
        objective: Of a stage of one group.
        parameters: Where the stage ended, shape (D,).
    """
    points = objective.model.elasticity.points
    extent = float((points.amax(0) - points.amin(0)).norm())
    steps = int(0.5 * extent / _STEP_MM)
    shifts = _STEP_MM * torch.arange(-steps, steps + 1, dtype=torch.float64)
    candidates = parameters.repeat(len(shifts), 1)
    candidates[:, _long_axis(objective)] += shifts
    losses = objective.losses(candidates)
    best = int(losses.argmin())
    return None if best == steps else candidates[best]


def _long_axis(objective: StageObjective) -> int:
    """Which parameter of the one group shifts the implant along its longest extent."""
    grid = objective.scene.deformation.grid
    spread = objective.model.elasticity.points.double() @ grid.frame[:3, :3].to(torch.float64)
    return 3 + int((spread.amax(0) - spread.amin(0)).argmax())

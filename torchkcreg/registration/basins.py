"""Where else an implant fits: plates with holes at even distances fit nearly as well one hole further."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.scene import Moves

from .objective import Objective

_STEP_MM = 2.0  # a coarse image's optimum is a few mm wide
_WORSE = 1.5  # times the least loss: what fits no better is no candidate
_MOST = 3


@torch.no_grad()
def places(objective: Objective, found: Tensor) -> list[Tensor]:
    """Parameters (D,) of a rigid stage from which the registration is worth trying, that found first.

    Others are where the loss has a minimum along an implant's long axis, up to half its length away, and the start,
    where the stage left it by more than a few steps: coarse pixels may prefer another place without seeing the holes.

    Args:
        objective: Of a rigid stage.
        found: Where the stage ended, shape (D,).
    """
    moves, others = objective.moves, []
    for number, assembly in enumerate(objective.scene):
        points = assembly.implant.points.double()
        steps = int(0.5 * float((points.amax(0) - points.amin(0)).norm()) / _STEP_MM)
        shifts = _STEP_MM * torch.arange(-steps, steps + 1, dtype=torch.float64, device=found.device)
        along = found + shifts[:, None] * moves.shift(number, assembly.implant.principal_axes()[1][2])
        losses = objective.losses(along)
        padded = torch.nn.functional.pad(losses[None], (1, 1), value=torch.inf)[0]
        minimum = (losses < padded[:-2]) & (losses <= padded[2:]) & (losses <= _WORSE * losses.min())
        minimum[steps - 1 : steps + 2] = False  # that is where it is
        order = losses.argsort()
        others += [along[i] for i in order.tolist() if minimum[i]][: _MOST - 1]
    start = torch.zeros_like(found)
    if _distance(moves, found, start) > 3 * _STEP_MM:
        others.append(start)
    return [found, *others]


def _distance(moves: Moves, one: Tensor, other: Tensor) -> float:
    """Root mean square distance of the implants' nodes, mm."""
    moved = moves.displacements(torch.stack([one, other]))
    return float((moved[0] - moved[1]).norm())

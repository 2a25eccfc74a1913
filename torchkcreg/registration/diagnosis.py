"""What is measured of a scene at the end of its registration, and how far it may be off."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchkcreg.scene import Assembly

from .objective import Objective
from .verdict import Diagnostics, Rival

_DIFFERENCE_MM = 0.01
_AT_BOUND = 0.01  # of a parameter's range
_NODES_PITCH_MM = 2.0


@torch.no_grad()
def seen_shares(assembly: Assembly, objective: Objective) -> list[float]:
    """Share of an implant's volume that projects on pixels that count, a view."""
    volumes, data = assembly.implant.coarsened(4).volumes, objective.images
    uv, depth = data.geometry.project(assembly.nodes(4))
    rows, cols = data.geometry.det_shape
    column, row = uv.round().long().unbind(-1)
    inside = (column >= 0) & (column < cols) & (row >= 0) & (row < rows) & (depth > 0)
    index = row.clamp(0, rows - 1) * cols + column.clamp(0, cols - 1)
    counts = inside & data.mask.flatten(1).gather(1, index)
    return (counts * volumes).sum(-1).div(volumes.sum()).tolist()


@torch.no_grad()
def diagnose(
    objective: Objective,
    gc: list[float],
    *,
    converged: bool,
    undone: Mapping[str, str],
    rival: Rival | None,
) -> Diagnostics:
    """What is measured of a scene at the end of its registration; of several implants, the worst.

    Deformations that want to know how sure they are, are told.

    Args:
        objective: Of the last stage there.
        gc: Gradient correlation of each view.
        converged: Whether the last stage ended before its iterations did.
        undone: Number of each stage that was undone, from 1 on, and why.
        rival: Where the implants fitted second best, if several places were tried.
    """
    rest, scene = objective.at_rest, objective.scene
    known = objective.uncertainty(rest[0])
    covariance = known.covariance
    objective.moves.keep_covariance(covariance)
    seen = [seen_shares(assembly, objective) for assembly in scene]
    return Diagnostics(
        gc=gc,
        misfit=1 - float(objective.similarities(rest).mean()),
        node_std_mm=node_deviation(objective, rest[0], covariance),
        surprise=max(assembly.deformation.surprise() for assembly in scene),
        effective_parameters=known.effective_parameters,
        blocks=known.blocks,
        seen=[min(shares) for shares in zip(*seen, strict=True)],
        strain=max(assembly.rms_strain() for assembly in scene),
        folds=any(_folds(assembly) for assembly in scene),
        converged=converged,
        at_bounds=objective.moves.at_bounds(_AT_BOUND),
        undone=dict(undone),
        rival=rival,
        screws_found=sum(len(assembly.found) for assembly in scene),
    )


def _folds(assembly: Assembly) -> bool:
    points = assembly.implant.coarsened_to(_NODES_PITCH_MM).points.double()
    return bool((assembly.deformation.jacobian_determinant(points) <= 0).any())


@torch.no_grad()
def node_deviation(objective: Objective, parameters: Tensor, covariance: Tensor) -> float:
    """Expected root mean square error of the implant's nodes for the parameters' covariance (D, D), mm."""
    moves = _node_moves(objective, parameters)
    return float(torch.einsum("sd,de,se->", moves, covariance, moves).clamp_min(0).sqrt())


def _node_moves(objective: Objective, parameters: Tensor) -> Tensor:
    """Derivatives (S, D) of the nodes' displacements, weighted so that their squares sum to the mean square."""
    offsets = _DIFFERENCE_MM * torch.eye(len(parameters), dtype=parameters.dtype, device=parameters.device)
    ahead, behind = (objective.moves.displacements(parameters + s * offsets) for s in (1, -1))
    return ((ahead - behind) / (2 * _DIFFERENCE_MM)).T

"""Quality measures of a registered scene, and its expected errors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchkcreg.deformation import Deviations, depth_direction
from torchkcreg.scene import Assembly

from .objective import Objective
from .verdict import Diagnostics, Rival

_AT_BOUND = 0.01  # of a parameter's range
_NODES_PITCH_MM = 2.0


@torch.no_grad()
def seen_shares(assembly: Assembly, objective: Objective) -> list[float]:
    """Share of an implant's volume that projects on valid pixels, for each view."""
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
) -> tuple[Diagnostics, list[Deviations]]:
    """Quality measures of a registered scene (the worst of several implants) and the deviations of each implant.

    Deformations that keep their covariance receive it.

    Args:
        objective: Objective of the last stage, at the result.
        gc: Gradient correlation of each view.
        converged: True if the last stage ended before its last iteration.
        undone: Number of each stage that was undone, from 1 on, and why.
        rival: Second best place of the implants, if several were tried.
    """
    rest, scene = objective.at_rest, objective.scene
    known = objective.uncertainty(rest[0])
    deviations = deviations_of(objective, known.covariance)
    seen = [seen_shares(assembly, objective) for assembly in scene]
    diagnostics = Diagnostics(
        gc=gc,
        misfit=1 - float(objective.similarities(rest).mean()),
        node_std_mm=max(implant.rms.whole for implant in deviations),
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
        view_motion_mm=None if scene.view_motions is None else scene.view_motions.rms_mm,
        screws_found=sum(len(assembly.found) for assembly in scene),
    )
    return diagnostics, deviations


def _folds(assembly: Assembly) -> bool:
    points = assembly.implant.coarsened_to(_NODES_PITCH_MM).points.double()
    return bool((assembly.deformation.jacobian_determinant(points) <= 0).any())


@torch.no_grad()
def deviations_of(objective: Objective, covariance: Tensor) -> list[Deviations]:
    """Expected deviations of each implant, from the covariance (D, D) of all parameters."""
    deviations = []
    for number, block in enumerate(objective.moves.keep_covariance(covariance)):
        nodes = objective.scene.assemblies[number].nodes()
        depth = depth_direction(objective.images.geometry.source_positions.to(nodes), nodes.mean(0))
        deviations.append(Deviations.of(*objective.moves.slopes(number), block, depth))
    return deviations

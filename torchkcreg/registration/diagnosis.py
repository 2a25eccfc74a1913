"""What is measured of a scene at the end of its registration, and how far it may be off."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchkcreg.parameters import ParameterBlocks
from torchkcreg.scene import Assembly

from .objective import Objective
from .verdict import Diagnostics, Rival

_BLOCK_MM = 12.0  # on the detector: residuals of bone edges, beads and scatter hang together over about that much
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
    covariance = parameter_covariance(objective, rest[0])
    objective.moves.keep_covariance(covariance)
    seen = [seen_shares(assembly, objective) for assembly in scene]
    return Diagnostics(
        gc=gc,
        misfit=1 - float(objective.similarities(rest).mean()),
        node_std_mm=node_deviation(objective, rest[0], covariance),
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
def parameter_covariance(objective: Objective, parameters: Tensor) -> Tensor:
    """Covariance (D, D) of the parameters at the optimum of a stage, mm^2.

    ``C = H^-1 (sum_b g_b g_b^T + 2 w P) H^-1`` (Huber 1967; clusters as in Liang & Zeger 1986): H is the curvature of
    the loss, penalties included, g_b the share that one block of pixels has in its gradient. The blocks' shares sum to
    nothing but the penalty's gradient; what they scatter is how far the optimum would move if the blocks had been
    others. That holds for model error too, which is no noise: what matters is that it hangs together within blocks and
    not beyond. Where a penalty is w times the square of deviations from a prior, its curvature P draws the optimum
    towards what the prior expects, which is as likely off as that says: 2 w P.

    Args:
        objective: Of a stage whose parameters are at their optimum.
        parameters: The optimum, shape (D,).
    """
    jacobian, residuals = objective.jacobian(parameters, _DIFFERENCE_MM)
    curvature = objective.curvature_from(jacobian, parameters)
    size = max(1, round(_BLOCK_MM / objective.view.geometry.pixel_spacing[1]))
    shares = torch.stack([_block_sums((row * residuals).sum(1), size) for row in jacobian]).double()
    shares = 0.5 / objective.images.num_views * shares
    blocks = max(int((shares != 0).any(0).sum()), 2)
    inner = blocks / (blocks - 1) * shares @ shares.T + _of_priors(objective.moves, parameters)
    floor = (
        1e-9 * curvature.diagonal().mean() * torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    )
    bread = torch.linalg.inv(curvature + floor)
    return bread @ inner @ bread


def _of_priors(blocks: ParameterBlocks, parameters: Tensor) -> Tensor:
    """2 w P of every block, (D, D)."""
    parts = []
    for name, steps in blocks.split(parameters).items():
        block, size = blocks[name], len(steps)
        part = parameters.new_zeros(size, size)
        if block.loss_of_deviation:
            part = torch.func.hessian(lambda p, block=block: block.penalty(p[None])[0])(steps)
        parts.append(2 * block.loss_of_deviation * part)
    return torch.block_diag(*parts)


@torch.no_grad()
def node_deviation(objective: Objective, parameters: Tensor, covariance: Tensor) -> float:
    """Expected root mean square error of the implant's nodes for the parameters' covariance (D, D), mm."""
    moves = _node_moves(objective, parameters)
    return float(torch.einsum("sd,de,se->", moves, covariance, moves).clamp_min(0).sqrt())


def _block_sums(images: Tensor, size: int) -> Tensor:
    """Sums (V * blocks,) of images (V, rows, cols) over squares of pixels."""
    return torch.nn.functional.avg_pool2d(images[None], size, ceil_mode=True, divisor_override=1).flatten()


def _node_moves(objective: Objective, parameters: Tensor) -> Tensor:
    """Derivatives (S, D) of the nodes' displacements, weighted so that their squares sum to the mean square."""
    offsets = _DIFFERENCE_MM * torch.eye(len(parameters), dtype=parameters.dtype, device=parameters.device)
    ahead, behind = (objective.moves.displacements(parameters + s * offsets) for s in (1, -1))
    return ((ahead - behind) / (2 * _DIFFERENCE_MM)).T

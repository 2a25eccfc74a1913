"""How sure images are of parameters: what blocks of pixels disagree about, and what a prior is worth beside them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchkcreg.parameters import ParameterBlocks

from .objective import Objective

_BLOCK_MM = 12.0  # on the detector: residuals of bone edges, beads and scatter hang together over about that much
_DIFFERENCE_MM = 0.01
_SEEN = 1e-3  # of the largest curvature: directions that images tell something about


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
    curvature, disagreement = _of_images(objective, parameters)
    curvature = curvature + _curvature(objective.penalty, parameters)
    floor = curvature.diagonal().mean() * torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    bread = torch.linalg.inv(curvature + 1e-9 * floor)
    return bread @ (disagreement + _of_priors(objective.moves, parameters)) @ bread


@torch.no_grad()
def loss_of_a_deviation(objective: Objective, parameters: Tensor) -> float:
    """The loss that images alone have where a parameter is one standard deviation off what they say.

    Half the ratio of what blocks of pixels disagree about to curvature; it is about the same in all directions. A prior
    that is one standard deviation off at the same loss is as likely off as the images, and counts as it should.

    Args:
        objective: Of a stage.
        parameters: Near its optimum, shape (D,).
    """
    curvature, disagreement = _of_images(objective, parameters)
    values, directions = torch.linalg.eigh(curvature)
    seen = values > _SEEN * values.max()
    ratio = torch.einsum("da,de,ea->a", directions, disagreement, directions)[seen] / values[seen]
    return float(ratio.median()) / 2


def _of_images(objective: Objective, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Curvature (D, D) of the similarity, and the sum (D, D) of its blocks' gradients' squares."""
    jacobian, residuals = objective.jacobian(parameters, _DIFFERENCE_MM)
    share = 0.5 / objective.images.num_views
    flat = jacobian.flatten(1)
    curvature = share * (flat @ flat.T).double()
    size = max(1, round(_BLOCK_MM / objective.view.geometry.pixel_spacing[1]))
    shares = share * torch.stack([_block_sums((row * residuals).sum(1), size) for row in jacobian]).double()
    blocks = max(int((shares != 0).any(0).sum()), 2)
    return curvature, blocks / (blocks - 1) * shares @ shares.T


def _of_priors(blocks: ParameterBlocks, parameters: Tensor) -> Tensor:
    """2 w P of every block, (D, D)."""
    parts = []
    for name, steps in blocks.split(parameters).items():
        weight = blocks[name].loss_of_deviation
        whole = steps.new_zeros(len(steps), len(steps))
        parts.append(2 * weight * _curvature(blocks[name].penalty, steps) if weight else whole)
    return torch.block_diag(*parts)


def _curvature(penalty: Callable[[Tensor], Tensor], parameters: Tensor) -> Tensor:
    return torch.autograd.functional.hessian(lambda p: penalty(p[None])[0], parameters)


def _block_sums(images: Tensor, size: int) -> Tensor:
    """Sums (V * blocks,) of images (V, rows, cols) over squares of pixels."""
    return torch.nn.functional.avg_pool2d(images[None], size, ceil_mode=True, divisor_override=1).flatten()

"""How far a registration may be off: the sandwich covariance of its parameters, carried to the implant's nodes."""

from __future__ import annotations

import torch
from torch import Tensor

from .objective import Objective

_BLOCK_MM = 12.0  # on the detector: residuals of bone edges, beads and scatter hang together over about that much
_DIFFERENCE_MM = 0.01


@torch.no_grad()
def node_deviation(objective: Objective, parameters: Tensor) -> float:
    """Expected root mean square error of the implant's nodes at the optimum of a stage, mm.

    ``C = H^-1 (sum_b g_b g_b^T) H^-1`` (Huber 1967; clusters as in Liang & Zeger 1986): H is the curvature of the loss,
    penalties included, g_b the share that one block of pixels has in its gradient. The blocks' shares sum to nothing
    but the penalty's gradient; what they scatter is how far the optimum would move if the blocks had been others. That
    holds for model error too, which is no noise: what matters is that it hangs together within blocks and not beyond.

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
    inner = blocks / (blocks - 1) * shares @ shares.T
    floor = 1e-9 * curvature.diagonal().mean() * torch.eye(len(curvature)).to(curvature)
    bread = torch.linalg.inv(curvature + floor)
    moves = _node_moves(objective, parameters)
    return float(torch.einsum("sd,de,se->", moves, bread @ inner @ bread, moves).clamp_min(0).sqrt())


def _block_sums(images: Tensor, size: int) -> Tensor:
    """Sums (V * blocks,) of images (V, rows, cols) over squares of pixels."""
    return torch.nn.functional.avg_pool2d(images[None], size, ceil_mode=True, divisor_override=1).flatten()


def _node_moves(objective: Objective, parameters: Tensor) -> Tensor:
    """Derivatives (S, D) of the nodes' displacements, weighted so that their squares sum to the mean square."""
    offsets = _DIFFERENCE_MM * torch.eye(len(parameters)).to(parameters)
    ahead, behind = (objective.moves.displacements(parameters + s * offsets) for s in (1, -1))
    return ((ahead - behind) / (2 * _DIFFERENCE_MM)).T

"""Whether views stood otherwise than the geometry has it, asked of the images themselves."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .objective import Objective

_LEAST_MM, _LEAST_STRENGTH = 0.05, 4.0


class ViewEvidence(NamedTuple):
    """What motions of the views would explain of the images.

    Attributes:
        motion_mm: How far the likeliest of them move the nodes, root mean square over the views.
        strength: By how much the loss would fall, in losses of a deviation for each of their parameters that the images
            determine: about one where nothing moved.
    """

    motion_mm: float
    strength: float

    @property
    def is_strong(self) -> bool:
        """Whether the views have moved."""
        return self.motion_mm > _LEAST_MM and self.strength > _LEAST_STRENGTH


def view_evidence(objective: Objective) -> ViewEvidence:
    """What motions of the views would explain beside all else that is free in an objective; their prior is weighed."""
    rest = objective.at_rest[0]
    jacobian, residuals = objective.jacobian(rest)
    objective.moves["views"].weigh(objective.uncertainty_from(jacobian, residuals, rest).loss_of_a_deviation)
    known = objective.uncertainty_from(jacobian, residuals, rest)  # with that weight
    leaf = rest.clone().requires_grad_(True)
    (against,) = torch.autograd.grad(objective.penalty(leaf[None])[0], leaf)
    slope = 0.5 / len(residuals) * (jacobian.flatten(1) @ residuals.flatten()).double() + against
    views = torch.zeros(len(slope), dtype=torch.bool, device=slope.device)
    views[objective.moves.places["views"]] = True
    others, whole = (~views).nonzero().flatten(), known.images + known.penalties
    step, gain, number = _best(whole, known.images, slope)
    _, less, fewer = _best(whole[others][:, others], known.images[others][:, others], slope[others])
    motion = step[views].unflatten(0, (-1, 6)).square().sum(-1).mean().sqrt()
    return ViewEvidence(float(motion), float((gain - less) / (known.loss_of_a_deviation * (number - fewer))))


def _best(curvature: Tensor, images: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The step to the optimum, by how much the loss falls on it, and how many parameters the images determine."""
    same = torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    inverse = torch.linalg.inv(curvature + 1e-9 * curvature.diagonal().mean() * same)
    step = -inverse @ slope
    return step, -0.5 * slope @ step, (inverse @ images).trace()

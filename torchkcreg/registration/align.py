"""Whether views stood otherwise than the geometry has it, asked of the images themselves."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .objective import Objective

_WEIGHINGS = 2
_LEAST_STRENGTH = 25.0  # in simulations up to 16 where the geometry was right, 70 and more where it was off by 0.3 mm


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
        return self.strength > _LEAST_STRENGTH


def view_evidence(objective: Objective) -> ViewEvidence:
    """What motions of the views would explain beside all else that is free in an objective; their prior is weighed.

    A deviation is measured by what would be left of the residual images where the views had moved: what they are at
    odds about now may be all that is left.
    """
    rest = objective.at_rest[0]
    jacobian, residuals = objective.jacobian(rest)
    left = residuals
    for _ in range(_WEIGHINGS):
        objective.moves["views"].weigh(objective.uncertainty_from(jacobian, left, rest).loss_of_a_deviation)
        known = objective.uncertainty_from(jacobian, left, rest)  # with that weight
        slope = 0.5 / len(residuals) * (jacobian.flatten(1) @ residuals.flatten()).double()
        slope = slope + _slope(objective, rest)
        step, gain, number = _best(known.images + known.penalties, known.images, slope)
        left = residuals + torch.einsum("d,dvkij->vkij", step.to(jacobian), jacobian)
    views = objective.moves.places["views"]
    others = torch.ones_like(slope, dtype=torch.bool)
    others[views] = False
    images, whole = (m[others][:, others] for m in (known.images, known.images + known.penalties))
    _, less, fewer = _best(whole, images, slope[others])
    motion = step[views].unflatten(0, (-1, 6)).square().sum(-1).mean().sqrt()
    told = (number - fewer).clamp_min(1.0)
    return ViewEvidence(float(motion), float((gain - less) / (known.loss_of_a_deviation * told)))


def _slope(objective: Objective, at: Tensor) -> Tensor:
    """Gradient (D,) of what speaks against parameters (D,) but the images."""
    leaf = at.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(objective.penalty(leaf[None])[0], leaf)
    return slope


def _best(curvature: Tensor, images: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The step to the optimum, by how much the loss falls on it, and how many parameters the images determine."""
    same = torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    inverse = torch.linalg.inv(curvature + 1e-9 * curvature.diagonal().mean() * same)
    step = -inverse @ slope
    return step, -0.5 * slope @ step, (inverse @ images).trace()

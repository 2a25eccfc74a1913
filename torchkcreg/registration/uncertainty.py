"""Uncertainty of estimated parameters, from the disagreement of pixel blocks, and the weight of priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import principal_axes
from torchkcreg.optimization.parameters import ParameterBlocks

_BLOCK_MM = 12.0  # on the detector: correlation length of residuals of bone edges, beads and scatter
_SEEN = 1e-3  # of the largest curvature: directions that images tell something about
_ONE_SIDE_DEG = 10.0  # about the implant's long axis: views so near each other show the same bone behind it
_FOUND = 1.5  # how much further off optima were in simulations where screws were found, see docs/uncertainty.md
_FOUND_A_SIDE = 1.5  # power of the number of views from one side then: they agree on a wrong screw


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Second derivatives (D, D) of a stage's loss near its optimum, and the covariance that follows.

    Attributes:
        images: Curvature of the similarity.
        disagreement: Sum of the squares of its gradients over blocks of pixels, multiplied by the factor for views with
            common model errors.
        penalties: Curvature of penalties and priors.
        priors: Twice the weight of each prior times its curvature.
        blocks: Number of pixel blocks that contribute.
    """

    images: Tensor
    disagreement: Tensor
    penalties: Tensor
    priors: Tensor
    blocks: int

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        jacobian: Tensor,
        residuals: Tensor,
        blocks: ParameterBlocks,
        penalty: Callable[[Tensor], Tensor],
        parameters: Tensor,
        *,
        pixel_mm: float,
        views_a_side: float = 1.0,
        screws_found: bool = False,
    ) -> Uncertainty:
        """The uncertainty from residual images.

        Args:
            jacobian: Derivatives (D, V, 2, rows, cols) of the residual images.
            residuals: Residual images, shape (V, 2, rows, cols).
            blocks: The parameters.
            penalty: Of candidates (K, D).
            parameters: The optimum, shape (D,).
            pixel_mm: Of the images.
            views_a_side: Number of views that share a direction: their model errors are correlated.
            screws_found: True if screws were found, not given: their errors exceed what the images show.
        """
        factor = _FOUND**2 * views_a_side**_FOUND_A_SIDE if screws_found else views_a_side
        share = 0.5 / len(residuals)
        flat = jacobian.flatten(1)
        size = max(1, round(_BLOCK_MM / pixel_mm))
        shares = share * torch.stack([_block_sums((row * residuals).sum(1), size) for row in jacobian]).double()
        number = max(int((shares != 0).any(0).sum()), 2)
        return cls(
            share * (flat @ flat.T).double(),
            factor * number / (number - 1) * shares @ shares.T,
            _curvature(penalty, parameters),
            _of_priors(blocks, parameters),
            number,
        )

    @property
    def covariance(self) -> Tensor:
        """Covariance (D, D) of the parameters, mm^2.

        `C = H^-1 (sum_b g_b g_b^T + 2 w P) H^-1` (Huber 1967; clusters as in Liang & Zeger 1986): H is the curvature
        of the loss, penalties included, g_b the share that one block of pixels has in its gradient. At the
        optimum the g_b sum to minus the penalties' gradient. Their spread tells how far the optimum would move if other
        blocks had been measured. This includes model error if it is correlated within blocks but not beyond. It is
        correlated between views from similar directions, so the sum is multiplied by their number. A penalty w times
        the squared deviations from a prior, with curvature P, pulls the optimum towards the prior's mean, which is
        itself uncertain: this adds 2 w P.
        """
        bread = self._bread()
        return bread @ (self.disagreement + self.priors) @ bread

    @property
    def loss_of_a_deviation(self) -> float:
        """Loss of the images for a parameter one standard deviation from their optimum.

        Half the ratio of the blocks' disagreement to the curvature, about the same in all directions. A prior is
        weighted correctly if its standard deviation costs the same.
        """
        values, directions = torch.linalg.eigh(self.images)
        seen = values > _SEEN * values.max()
        ratio = torch.einsum("da,de,ea->a", directions, self.disagreement, directions)[seen] / values[seen]
        return float(ratio.median()) / 2

    @property
    def effective_parameters(self) -> float:
        """Number of parameters determined by the images rather than penalties: the trace of H^-1 H_images."""
        return float((self._bread() @ self.images).trace())

    def _bread(self) -> Tensor:
        whole = self.images + self.penalties
        same = torch.eye(len(whole), dtype=whole.dtype, device=whole.device)
        return torch.linalg.inv(whole + 1e-9 * whole.diagonal().mean() * same)


def views_a_side(sources: Tensor, nodes: Tensor) -> float:
    """Average number of views from sources (V, 3) that share a direction onto an implant of nodes (N, 3)."""
    return float(likeness(sources, nodes).sum() / len(sources))


def likeness(sources: Tensor, nodes: Tensor) -> Tensor:
    """Similarity of direction (V, V) of pairs of views from sources (V, 3) onto an implant of nodes (N, 3).

    1 for the same direction, towards 0 for others, by the angle between them about the implant's long axis.
    """
    center, (*_, axis) = principal_axes(nodes)
    rays = torch.nn.functional.normalize(center - sources, dim=-1)
    across = torch.nn.functional.normalize(rays - (rays @ axis)[:, None] * axis, dim=-1)
    angles = torch.rad2deg(torch.acos((across @ across.mT).clamp(-1, 1)))
    return torch.exp(-0.5 * (angles / _ONE_SIDE_DEG).square())


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

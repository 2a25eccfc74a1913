"""How sure images are of parameters: what blocks of pixels disagree about, and what a prior is worth beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import principal_axes
from torchkcreg.optimization.parameters import ParameterBlocks

_BLOCK_MM = 12.0  # on the detector: residuals of bone edges, beads and scatter hang together over about that much
_SEEN = 1e-3  # of the largest curvature: directions that images tell something about
_ONE_SIDE_DEG = 10.0  # about the implant's long axis: views so near each other show the same bone behind it
_FOUND = 1.5  # how much further off optima were in simulations where screws were found, see docs/uncertainty.md
_FOUND_A_SIDE = 1.5  # power of the number of views from one side then: they agree on a wrong screw


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known of parameters (D,) near the optimum of a stage; second derivatives of the loss, (D, D).

    Attributes:
        images: Curvature of the similarity.
        disagreement: Sum of the squares of its gradients over blocks of pixels, as much larger as views share what the
            model lacks.
        penalties: Curvature of what speaks against parameters but the images.
        priors: Twice the weight of each prior times its curvature.
        blocks: How many blocks of pixels say something.
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
        """Of residual images.

        Args:
            jacobian: Their derivatives (D, V, 2, rows, cols).
            residuals: Shape (V, 2, rows, cols).
            blocks: The parameters.
            penalty: Of candidates (K, D).
            parameters: The optimum, shape (D,).
            pixel_mm: Of the images.
            views_a_side: How many views look from one side: all that the model lacks they have in common, and they
                agree with each other on what is wrong.
            screws_found: Screws were found, not given: more may be wrong with them than images tell.
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

        ``C = H^-1 (sum_b g_b g_b^T + 2 w P) H^-1`` (Huber 1967; clusters as in Liang & Zeger 1986): H is the curvature
        of the loss, penalties included, g_b the share that one block of pixels has in its gradient. The blocks' shares
        sum to nothing but the penalty's gradient; what they scatter is how far the optimum would move if the blocks had
        been others. That holds for model error too, which is no noise: what matters is that it hangs together within
        blocks and not beyond. Between views from one side it does, so that their number multiplies it. Where a penalty
        is w times the square of deviations from a prior, its curvature P draws the optimum towards what the prior
        expects, which is as likely off as that says: 2 w P.
        """
        bread = self._bread()
        return bread @ (self.disagreement + self.priors) @ bread

    @property
    def loss_of_a_deviation(self) -> float:
        """The loss that images alone have where a parameter is one standard deviation off what they say.

        Half the ratio of what blocks of pixels disagree about to curvature; it is about the same in all directions. A
        prior whose standard deviation costs as much counts as it should beside the images.
        """
        values, directions = torch.linalg.eigh(self.images)
        seen = values > _SEEN * values.max()
        ratio = torch.einsum("da,de,ea->a", directions, self.disagreement, directions)[seen] / values[seen]
        return float(ratio.median()) / 2

    @property
    def effective_parameters(self) -> float:
        """How many parameters the images determine, the rest being left to penalties: the trace of H^-1 H_images."""
        return float((self._bread() @ self.images).trace())

    def _bread(self) -> Tensor:
        whole = self.images + self.penalties
        same = torch.eye(len(whole), dtype=whole.dtype, device=whole.device)
        return torch.linalg.inv(whole + 1e-9 * whole.diagonal().mean() * same)


def views_a_side(sources: Tensor, nodes: Tensor) -> float:
    """How many of the views from sources (V, 3) look at an implant of nodes (N, 3) from one side, on average."""
    return float(likeness(sources, nodes).sum() / len(sources))


def likeness(sources: Tensor, nodes: Tensor) -> Tensor:
    """How much each pair of views from sources (V, 3) looks at an implant of nodes (N, 3) from one side, (V, V).

    1 for the same side, 0 for others, by the angle between them about the implant's long axis.
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

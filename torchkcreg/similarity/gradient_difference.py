"""Gradient difference: gradient correlation that sees the contrast, not only its shape."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.similarity.gradient_correlation import OfGradients
from torchkcreg.similarity.ncc import largest_value
from torchkcreg.similarity.sobel import sobel_gradient


class GradientDifference(OfGradients):
    """How near the gradients of rendered images come to those of measured ones, 1 for a perfect match.

    ``GD = 1 - sum_d |d y - d y*|^2 / (4 |d y*|^2)`` over the Sobel derivatives d along u and v, their means taken out.
    Near a match it agrees with gradient correlation (eq. 4 of Cao et al. 2020), to which a factor of the contrast means
    nothing; here a contrast that is off costs. So scatter, which lowers it, and hardness can be told apart from motion.

    Args:
        fixed: Measured images, shape (V, rows, cols), finite where they count.
        mask: Shape (V, rows, cols), nonzero where pixels count; it is eroded by 3 x 3 pixels.
        weights: Shape (V, rows, cols), how much a pixel counts, not negative; all alike if None.

    Raises:
        ValueError: If shapes do not fit, weights are negative, or ``fixed`` is not finite at a pixel that counts.

    >>> x = torch.rand(3, 16, 16)
    >>> GradientDifference(x)(torch.stack([x + 1, 0 * x])).round(decimals=3).tolist()
    [[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]
    """

    inverse_norms: Tensor

    def __init__(self, fixed: Tensor, mask: Tensor | None = None, weights: Tensor | None = None) -> None:
        super().__init__(fixed, mask, weights)
        contrast = self._contrast(fixed.detach())
        norms = torch.linalg.vector_norm(contrast, dim=(-2, -1), keepdim=True)
        rounding = 16 * torch.finfo(fixed.dtype).eps * contrast[0, 0].numel() ** 0.5
        flat = norms <= rounding * largest_value(fixed)[:, None, None, None]
        self.register_buffer("inverse_norms", torch.where(flat, 0.0, 1 / norms))
        self.register_buffer("unit_gradients", contrast * self.inverse_norms)

    def forward(self, moving: Tensor) -> Tensor:
        """GD of each view, shape (..., V), of rendered images (..., V, rows, cols)."""
        return self.in_blocks(lambda block: 1 - 0.25 * self._residuals(block).square().sum((-3, -2, -1)), moving)

    def residuals(self, moving: Tensor) -> Tensor:
        """Differences of the gradients (..., V, 2, rows, cols), whose squares sum to 4 (1 - GD)."""
        return self.in_blocks(self._residuals, moving)

    def _residuals(self, moving: Tensor) -> Tensor:
        return self._contrast(moving) * self.inverse_norms - self.unit_gradients

    def _contrast(self, images: Tensor) -> Tensor:
        """Derivatives (..., V, 2, rows, cols) without their weighted means, times the roots of the weights."""
        if self.mask is not None:
            images = torch.where(self.mask, images, 0.0)
        gradients = sobel_gradient(images)
        if self.eroded_mask is None:
            return gradients - gradients.mean((-2, -1), keepdim=True)
        weight = self.eroded_mask[..., None, :, :].to(gradients)
        mean = (gradients * weight).sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)
        return (gradients - mean) * weight.sqrt()

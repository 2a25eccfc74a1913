"""Gradient correlation (GC), the similarity of eq. 4 of Cao et al. (2020), and gradient difference (GD)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchkcreg.precision import full_precision

from .ncc import largest_value, unit_contrast
from .similarity import Similarity
from .sobel import erode_mask, sobel_gradient

# Pixels per block on a CPU; larger batches are processed in several blocks. The buffers of a block stay in cache, while
# those of a whole population would be allocated from the operating system and freed in every pass.
_PIXELS_PER_BLOCK = 2**18


@full_precision
def gradient_correlation(moving: Tensor, fixed: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Gradient correlation of each view, 1 for a perfect match (eq. 4 of Cao et al. 2020).

    GC = (NCC(d_u moving, d_u fixed) + NCC(d_v moving, d_v fixed)) / 2 with Sobel derivatives. Means and sums of the NCC
    run over the mask. GC(a x + b) = GC(x) for a > 0. A flat derivative image contributes 0, with zero gradient, never
    NaN.

    Args:
        moving: Rendered images, shape (..., V, rows, cols).
        fixed: Measured images, shape (V, rows, cols) or with leading axes that broadcast against those of `moving`.
        mask: Shape (V, rows, cols), nonzero where pixels are used. It is eroded by 3 x 3 pixels, so values of masked
            pixels (NaN included) never enter. None uses all pixels.

    Returns:
        Tensor of shape (..., V), differentiable in both images.

    Raises:
        ValueError: If shapes do not match.

    Example:
        >>> x = torch.rand(2, 16, 16)
        >>> gradient_correlation(torch.stack([2 * x + 1, -x]), x).round(decimals=4)
        tensor([[ 1.,  1.],
                [-1., -1.]])
    """
    check_images(moving, fixed)
    if mask is not None:
        _check_mask(mask, fixed)
    eroded = None if mask is None else erode_mask(mask)
    unit_fixed = _unit_gradients(fixed, mask, eroded)
    return in_blocks(lambda block: _correlate(block, unit_fixed, mask, eroded), moving, whole=fixed.ndim > 3)


class OfGradients(Similarity):
    """Base class of gradient similarities: stores masks, weights and gradients of the measured images.

    Args:
        fixed: Measured images, see `GradientCorrelation`.
        mask: See `GradientCorrelation`.
        weights: See `GradientCorrelation`.
    """

    unit_gradients: Tensor
    mask: Tensor | None
    eroded_mask: Tensor | None

    def __init__(self, fixed: Tensor, mask: Tensor | None, weights: Tensor | None) -> None:
        super().__init__()
        mask, eroded = _weights_of_pixels(fixed, mask, weights)
        self.register_buffer("mask", mask)
        self.register_buffer("eroded_mask", eroded)

    @property
    def num_views(self) -> int:
        """Number of views V."""
        return self.unit_gradients.shape[0]

    def in_blocks(self, function: Callable[[Tensor], Tensor], moving: Tensor) -> Tensor:
        """Apply `function` to rendered images (..., V, rows, cols) in blocks, after a check of their shape."""
        check_images(moving, self.unit_gradients[:, 0])
        return in_blocks(function, moving)


class GradientCorrelation(OfGradients):
    """Gradient correlation with fixed measured images, whose gradients are computed once.

    Args:
        fixed: Measured images, shape (V, rows, cols), finite inside the mask.
        mask: Shape (V, rows, cols), nonzero where pixels are used, see `gradient_correlation`.
        weights: Weights of the pixels in means and sums, shape (V, rows, cols), not negative. None: all equal.

    Raises:
        ValueError: If shapes do not match, weights are negative, or `fixed` is not finite inside the mask.

    Attributes:
        unit_gradients: Buffer (V, 2, rows, cols), derivatives of `fixed` with mean 0 and norm 1 over the mask.
        mask: Boolean buffer (V, rows, cols) or None.
        eroded_mask: Buffer (V, rows, cols) or None, weight of each pixel's derivatives.

    Example:
        >>> x = torch.rand(3, 16, 16)
        >>> gc = GradientCorrelation(x)
        >>> candidates = x + torch.zeros(5, 1, 1, 1)
        >>> gc(candidates).shape, gc.residuals(candidates).shape
        (torch.Size([5, 3]), torch.Size([5, 3, 2, 16, 16]))
    """

    def __init__(self, fixed: Tensor, mask: Tensor | None = None, weights: Tensor | None = None) -> None:
        super().__init__(fixed, mask, weights)
        self.register_buffer("unit_gradients", _unit_gradients(fixed.detach(), self.mask, self.eroded_mask))

    def forward(self, moving: Tensor) -> Tensor:
        """GC of each view, shape (..., V), of rendered images (..., V, rows, cols)."""
        return self.in_blocks(lambda b: _correlate(b, self.unit_gradients, self.mask, self.eroded_mask), moving)

    def residuals(self, moving: Tensor) -> Tensor:
        """Differences between the unit gradients of `moving` and of the fixed images, for least-squares methods.

        Since 1 - NCC(a, b) = |a/|a| - b/|b||^2 / 2 for images without their means, the squares sum to the loss:
        1 - GC = sum residuals^2 / 4 over (2, rows, cols). Where `moving` is flat (NCC 0) the residuals are the fixed
        unit gradients, scaled so that this still holds. A flat fixed view carries no information: its residuals are 0.

        Args:
            moving: Rendered images, shape (..., V, rows, cols).

        Returns:
            Tensor of shape (..., V, 2, rows, cols).
        """
        fixed_says = (self.unit_gradients != 0).any(-1).any(-1)[..., None, None]

        def difference(block: Tensor) -> Tensor:
            unit = _unit_gradients(block, self.mask, self.eroded_mask)
            flat = torch.linalg.vector_norm(unit.detach(), dim=(-2, -1), keepdim=True) == 0
            target = torch.where(flat, math.sqrt(2.0), 1.0).to(self.unit_gradients.dtype) * self.unit_gradients
            return unit * fixed_says - target

        return self.in_blocks(difference, moving)


class GradientCorrelationLoss(nn.Module):
    """Mean of 1 - GC over the views: 0 for a perfect match, 2 at worst.

    Args:
        fixed: Measured images, shape (V, rows, cols).
        mask: Shape (V, rows, cols), nonzero where pixels are used, see `gradient_correlation`.

    Example:
        >>> x = torch.rand(3, 16, 16)
        >>> GradientCorrelationLoss(x)(x).abs() < 1e-5
        tensor(True)
    """

    def __init__(self, fixed: Tensor, mask: Tensor | None = None) -> None:
        super().__init__()
        self.similarity = GradientCorrelation(fixed, mask)

    def forward(self, moving: Tensor) -> Tensor:
        """Loss of each candidate, shape (...), of rendered images (..., V, rows, cols)."""
        return 1.0 - self.similarity(moving).mean(-1)


def _correlate(moving: Tensor, unit_fixed: Tensor, mask: Tensor | None, eroded: Tensor | None) -> Tensor:
    return 0.5 * (_unit_gradients(moving, mask, eroded) * unit_fixed).sum((-3, -2, -1))


def _unit_gradients(images: Tensor, mask: Tensor | None, eroded: Tensor | None) -> Tensor:
    """Sobel derivatives with mean 0 and norm 1 over the eroded mask, (..., V, 2, rows, cols); 0 where flat."""
    if mask is not None:
        images = torch.where(mask != 0, images, 0.0)  # before Sobel: NaN times a mask would stay NaN
    scale = largest_value(images)[..., None]
    return unit_contrast(sobel_gradient(images), None if eroded is None else eroded[..., None, :, :], scale)


def _weights_of_pixels(
    fixed: Tensor, mask: Tensor | None, weights: Tensor | None
) -> tuple[Tensor | None, Tensor | None]:
    """Boolean mask and the weight of each pixel's derivatives, checked against the fixed images."""
    if fixed.ndim != 3:
        raise ValueError(f"fixed must have shape (V, rows, cols), got {tuple(fixed.shape)}")
    if mask is not None:
        _check_mask(mask, fixed)
        mask = mask.detach() != 0
    counted = torch.isfinite(fixed) if mask is None else torch.isfinite(fixed) | ~mask
    if not counted.all():
        raise ValueError(f"fixed must be finite where it counts, got {int((~counted).sum())} pixels that are not")
    eroded = None if mask is None else erode_mask(mask)
    if weights is not None:
        _check_mask(weights, fixed)
        if not bool((weights >= 0).all()):
            raise ValueError("weights must not be negative")
        weights = weights.detach().to(fixed.dtype)
        eroded = weights if eroded is None else eroded * weights
    return mask, eroded


def in_blocks(function: Callable[[Tensor], Tensor], moving: Tensor, *, whole: bool = False) -> Tensor:
    """Apply `function` to (K, V, rows, cols) images, a few candidates at a time, and restore the leading axes."""
    if whole or moving.device.type != "cpu" or moving.numel() <= _PIXELS_PER_BLOCK:
        return function(moving)
    flat = moving.reshape(-1, *moving.shape[-3:])
    size = max(1, _PIXELS_PER_BLOCK // flat[0].numel())
    result = torch.cat([function(block) for block in flat.split(size)])
    return result.reshape(*moving.shape[:-3], *result.shape[1:])


def check_images(moving: Tensor, fixed: Tensor) -> None:
    """Raise ValueError unless images agree in (V, rows, cols)."""
    if fixed.ndim < 3 or moving.ndim < 3 or moving.shape[-3:] != fixed.shape[-3:]:
        raise ValueError(
            f"moving and fixed must agree in (V, rows, cols), got {tuple(moving.shape)} and {tuple(fixed.shape)}"
        )


def _check_mask(mask: Tensor, fixed: Tensor) -> None:
    if mask.shape != fixed.shape[-3:]:
        raise ValueError(f"mask and weights must have shape {tuple(fixed.shape[-3:])}, got {tuple(mask.shape)}")


class GradientDifference(OfGradients):
    """Gradient difference (GD): closeness of rendered and measured gradients, 1 for a perfect match.

    `GD = 1 - sum_d |d y - d y*|^2 / (4 |d y*|^2)` over the Sobel derivatives d along u and v, without their means.
    Near a match it agrees with gradient correlation (eq. 4 of Cao et al. 2020). Gradient correlation ignores a factor
    of the contrast; here a wrong contrast lowers the similarity. So scatter (which lowers contrast) and hardness can be
    distinguished from motion. A flat derivative of a measured view, or a view masked as a whole, agrees with nothing:
    it contributes 0, with zero gradient.

    Args:
        fixed: Measured images, shape (V, rows, cols), finite inside the mask.
        mask: Shape (V, rows, cols), nonzero where pixels are used. It is eroded by 3 x 3 pixels.
        weights: Weights of the pixels, shape (V, rows, cols), not negative. None: all equal.

    Raises:
        ValueError: If shapes do not match, weights are negative, or `fixed` is not finite inside the mask.

    >>> x = torch.rand(3, 16, 16)
    >>> GradientDifference(x)(torch.stack([x + 1, 0 * x])).round(decimals=3).tolist()
    [[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]
    """

    inverse_norms: Tensor
    best: Tensor

    def __init__(self, fixed: Tensor, mask: Tensor | None = None, weights: Tensor | None = None) -> None:
        super().__init__(fixed, mask, weights)
        seen = fixed.detach() if self.mask is None else torch.where(self.mask, fixed.detach(), 0.0)
        contrast = self._contrast(seen)
        norms = torch.linalg.vector_norm(contrast, dim=(-2, -1), keepdim=True)
        rounding = 16 * torch.finfo(fixed.dtype).eps * contrast[0, 0].numel() ** 0.5
        flat = norms <= rounding * largest_value(seen)[:, None, None, None]
        self.register_buffer("inverse_norms", torch.where(flat, 0.0, 1 / norms))
        self.register_buffer("unit_gradients", contrast * self.inverse_norms)
        self.register_buffer("best", 1 - 0.5 * flat.sum((-3, -2, -1)))

    def forward(self, moving: Tensor) -> Tensor:
        """GD of each view, shape (..., V), of rendered images (..., V, rows, cols)."""
        misfit = self.in_blocks(lambda block: 0.25 * self._residuals(block).square().sum((-3, -2, -1)), moving)
        return self.best - misfit

    def residuals(self, moving: Tensor) -> Tensor:
        """Normalised gradient differences (..., V, 2, rows, cols), whose squares sum to 4 (1 - GD).

        Those of a flat derivative are 0: it says nothing about the motion.
        """
        return self.in_blocks(self._residuals, moving)

    def _residuals(self, moving: Tensor) -> Tensor:
        return self._contrast(moving) * self.inverse_norms - self.unit_gradients

    def _contrast(self, images: Tensor) -> Tensor:
        """Derivatives (..., V, 2, rows, cols) minus their weighted means, times the square roots of the weights."""
        if self.mask is not None:
            images = torch.where(self.mask, images, 0.0)
        gradients = sobel_gradient(images)
        if self.eroded_mask is None:
            return gradients - gradients.mean((-2, -1), keepdim=True)
        weight = self.eroded_mask[..., None, :, :].to(gradients)
        mean = (gradients * weight).sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)
        return (gradients - mean) * weight.sqrt()

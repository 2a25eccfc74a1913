"""Normalised cross-correlation, with flat images handled explicitly."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.precision import full_precision

# An image counts as flat when its RMS contrast is below this many rounding errors of its largest value: what remains
# is rounding noise. The threshold is relative, so it does not depend on the scale of the values.
_FLAT_ROUNDINGS = 16.0


@full_precision
def normalized_cross_correlation(a: Tensor, b: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Normalised cross-correlation of each pair of images over its mask: 1 for a perfect match, -1 for an inverted one.

    NCC = sum (a - mean a)(b - mean b) / sqrt(sum (a - mean a)^2 sum (b - mean b)^2), sums and means over the mask.
    A flat image (no contrast beyond rounding, or empty mask) gives 0, with zero gradients.

    Args:
        a: Images, shape (..., rows, cols).
        b: Images that broadcast against `a`.
        mask: Shape (..., rows, cols), broadcastable, nonzero where pixels are used. Values of masked pixels
            (NaN included) never enter. None uses all pixels.

    Returns:
        Correlations of shape (...).

    Raises:
        ValueError: If the images or the mask have different (rows, cols).

    Example:
        >>> a = torch.rand(2, 8, 8)
        >>> normalized_cross_correlation(a, 3 * a + 1).round(decimals=4)
        tensor([1., 1.])
    """
    _check_same_size(a, b, "b")
    if mask is not None:
        _check_same_size(a, mask, "mask")
        a, b = (torch.where(mask != 0, image, 0.0) for image in (a, b))
    mask = None if mask is None else mask != 0
    unit_a, unit_b = (unit_contrast(image, mask, largest_value(image)) for image in (a, b))
    return (unit_a * unit_b).sum((-2, -1))


def unit_contrast(images: Tensor, mask: Tensor | None, scale: Tensor) -> Tensor:
    """Images minus their weighted mean, times the square roots of the weights, scaled to norm 1; all zero if flat.

    Args:
        images: Shape (..., rows, cols), finite.
        mask: Weights of the pixels, broadcastable to `images`, not negative. None: all equal.
        scale: Shape (...), the magnitude of the values that `images` were computed from. Images whose contrast is below
            16 rounding errors of it count as flat.

    Returns:
        Tensor of the shape of `images`. Its gradients are finite everywhere, and zero for flat images.
    """
    if mask is None:
        count = torch.tensor(float(images.shape[-2] * images.shape[-1]), dtype=images.dtype, device=images.device)
        contrast = images - images.mean((-2, -1), keepdim=True)
    else:
        weight = mask.to(images.dtype)
        count = weight.sum((-2, -1))
        mean = (images * weight).sum((-2, -1)) / count.clamp(min=torch.finfo(images.dtype).tiny)
        contrast = (images - mean[..., None, None]) * weight.sqrt()
    power = contrast.square().sum((-2, -1))
    floor = count * (_FLAT_ROUNDINGS * torch.finfo(images.dtype).eps * scale.detach()).square()
    sharp = power > floor.clamp(min=torch.finfo(images.dtype).tiny)
    # The inner `where` keeps the square root's infinite slope at 0 out of the backward pass.
    inverse_norm = torch.where(sharp, torch.where(sharp, power, 1.0).rsqrt(), 0.0)
    return contrast * inverse_norm[..., None, None]


def largest_value(images: Tensor) -> Tensor:
    """Largest absolute value of each image, shape (...), without gradient."""
    return torch.linalg.vector_norm(images.detach(), float("inf"), dim=(-2, -1))


def _check_same_size(a: Tensor, image: Tensor, name: str) -> None:
    if a.shape[-2:] != image.shape[-2:]:
        raise ValueError(f"{name} must have (rows, cols) = {tuple(a.shape[-2:])}, got shape {tuple(image.shape)}")

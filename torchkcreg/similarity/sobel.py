"""Sobel derivatives of images, and the mask of pixels with valid derivatives."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.filters import spatial_gradient
from torch import Tensor

from torchkcreg.kernels.differentiable import linear
from torchkcreg.precision import full_precision

# Adjoint kernels, (gradient image of u and v) -> image. Both Sobel kernels are odd: the rotation by 180 degrees that an
# adjoint needs only changes their sign.
_ADJOINT_SOBEL = (
    ((0.125, 0.0, -0.125), (0.25, 0.0, -0.25), (0.125, 0.0, -0.125)),
    ((0.125, 0.25, 0.125), (0.0, 0.0, 0.0), (-0.125, -0.25, -0.125)),
)


@full_precision
def sobel_gradient(images: Tensor) -> Tensor:
    """Sobel derivatives of images in grey values per pixel, along u (columns) first, then along v (rows).

    The kernel is normalised (a ramp of slope 1 has derivative 1) and the border pixels are repeated outwards, both
    as in `kornia.filters.spatial_gradient`, which is used here.

    Args:
        images: Shape (..., rows, cols) with any leading axes, floating point.

    Returns:
        Derivatives of shape (..., 2, rows, cols).

    Raises:
        ValueError: If `images` has fewer than two axes, is empty or is not floating point.

    Example:
        >>> ramp = torch.arange(5.0).expand(4, 5)
        >>> sobel_gradient(ramp)[0, 2]
        tensor([0.5000, 1.0000, 1.0000, 1.0000, 0.5000])
    """
    if images.ndim < 2 or images.numel() == 0:
        raise ValueError(f"images must have shape (..., rows, cols) and not be empty, got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise ValueError(f"images must be floating point, got {images.dtype}")
    # One channel each: kornia then folds all leading axes into the batch of a single convolution.
    flat = linear(images.reshape(-1, 1, *images.shape[-2:]), _sobel, _adjoint)
    return flat.reshape(*images.shape[:-2], 2, *images.shape[-2:])


def erode_mask(mask: Tensor) -> Tensor:
    """Mask of the pixels whose whole 3 x 3 neighbourhood is used, so that no masked value enters a derivative.

    Args:
        mask: Shape (..., rows, cols), nonzero where pixels are used. The image border does not mask anything.

    Returns:
        Boolean mask of the same shape.
    """
    bad = (mask == 0).to(torch.float32).reshape(-1, 1, *mask.shape[-2:])
    return (F.max_pool2d(bad, kernel_size=3, stride=1, padding=1) == 0).reshape(mask.shape)


def _sobel(images: Tensor) -> Tensor:
    """Kornia's Sobel filter: (B, 1, rows, cols) -> (B, 2, rows, cols)."""
    return spatial_gradient(images, mode="sobel", order=1, normalized=True).squeeze(1)


def _adjoint(gradients: Tensor) -> Tensor:
    """Adjoint of `_sobel`: (B, 2, rows, cols) -> (B, 1, rows, cols), as a plain convolution.

    The adjoint by autograd is a transposed convolution, which takes five to ten times as long on a CPU.
    """
    kernel = torch.tensor(_ADJOINT_SOBEL, dtype=gradients.dtype, device=gradients.device)[None]
    padded = F.conv2d(gradients, kernel, padding=2)
    # Adjoint of repeating the border: values outside are added to the border pixel they are copies of.
    padded[..., 1, :] += padded[..., 0, :]
    padded[..., -2, :] += padded[..., -1, :]
    padded[..., :, 1] += padded[..., :, 0]
    padded[..., :, -2] += padded[..., :, -1]
    return padded[..., 1:-1, 1:-1].contiguous()

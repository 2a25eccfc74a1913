"""Separable Gaussian blur of images, its kernel and its adjoint."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchkcreg.kernels import Operator, choose_backend
from torchkcreg.kernels.differentiable import linear

NUM_SIGMAS = 4.5
SMALLEST_SIGMA = 1e-3


def gaussian_kernel(sigma_px: Tensor) -> Tensor:
    """Gaussian samples at -R..R, summing to one: shape `(..., 2R + 1)` for sigmas `(...)`.

    R is 4.5 times the largest sigma. The tail beyond is 1e-5, so the result barely changes when R jumps by a pixel.
    Differentiable in sigma. A sigma of zero gives the identity, with a zero gradient.
    """
    sigma = sigma_px.abs().clamp_min(SMALLEST_SIGMA)
    largest = float(sigma.detach().max())
    radius = math.ceil(NUM_SIGMAS * largest) if largest > 0.05 else 0
    offsets = torch.arange(-radius, radius + 1, dtype=sigma.dtype, device=sigma.device)
    samples = torch.exp(-0.5 * (offsets / sigma[..., None]) ** 2)
    return samples / samples.sum(-1, keepdim=True)


def gaussian_blur(images: Tensor, sigma_px: Tensor | float, *, backend: str = "auto") -> Tensor:
    """Images `(..., rows, cols)` blurred by a Gaussian, with the border pixels repeated outwards.

    Args:
        images: Images, shape `(..., rows, cols)`.
        sigma_px: Standard deviation in pixels, the same in both directions and for all images.
        backend: "auto", "cpp", "triton" or "torch".

    Returns:
        Blurred images of the same shape, differentiable in the images.
    """
    sigma = torch.as_tensor(sigma_px, dtype=images.dtype, device=images.device)
    kernel = gaussian_kernel(sigma.detach())
    if len(kernel) == 1:
        return images * kernel
    if choose_backend(images, backend, operator=BLUR.name).is_reference:
        return _blurred(images, kernel)
    flat = images.reshape(-1, *images.shape[-2:])
    return linear(
        flat, lambda x: BLUR.dispatched(x, kernel, False), lambda x: BLUR.dispatched(x, kernel, True)
    ).reshape(images.shape)


def convolve(images: Tensor, kernel: list[float], dim: int) -> Tensor:
    """Correlate images with an odd kernel along one of their last two dimensions, with the border repeated."""
    radius, size = len(kernel) // 2, images.shape[dim]
    if radius == 0:
        return images * kernel[0]
    padded = _repeat_border(images, radius, dim)
    result = padded.narrow(dim, radius, size) * kernel[radius]
    for offset in range(len(kernel)):
        if offset != radius:
            result = _add_scaled(result, padded.narrow(dim, offset, size), kernel[offset])
    return result


def convolve_by(images: Tensor, kernel: Tensor, dim: int) -> Tensor:
    """`convolve` with one kernel (K, odd) per candidate (K, V, rows, cols); differentiable in both to any order."""
    radius, size = kernel.shape[-1] // 2, images.shape[dim]
    steps = torch.arange(size + 2 * radius, device=images.device).sub(radius).clamp(0, size - 1)
    padded = images.index_select(dim, steps)
    shares = kernel[:, None, None, None, :]
    result = torch.zeros_like(images)
    for offset in range(2 * radius + 1):
        result = result + padded.narrow(dim, offset, size) * shares[..., offset]
    return result


def _repeat_border(images: Tensor, radius: int, dim: int) -> Tensor:
    """Pad images with `radius` copies of their first and last line along a dimension."""
    sides = (0, 0, radius, radius) if dim == -2 else (radius, radius, 0, 0)
    flat = images.reshape(-1, 1, *images.shape[-2:])
    padded = pad(flat, sides, mode="replicate")
    return padded.reshape(*images.shape[:-2], *padded.shape[-2:])


def _add_scaled(total: Tensor, term: Tensor, scale: float) -> Tensor:
    """`total + scale * term`, in place unless autograd tracks `total`."""
    if total.requires_grad:
        return total.add(term, alpha=scale)
    return total.add_(term, alpha=scale)


def _blurred(images: Tensor, kernel: Tensor) -> Tensor:
    """Images correlated with an odd kernel along rows and columns."""
    samples = kernel.tolist()
    return convolve(convolve(images, samples, -2), samples, -1)


def _blur(images: Tensor, kernel: Tensor, transposed: bool) -> Tensor:
    """Reference in plain torch; the transpose by autograd."""
    if not transposed:
        return _blurred(images, kernel)
    leaf = torch.zeros_like(images).requires_grad_(True)
    with torch.enable_grad():
        return torch.autograd.grad(_blurred(leaf, kernel), leaf, images)[0]


# images (B, rows, cols), kernel (odd,) -> (B, rows, cols)
BLUR = Operator(
    "blur(Tensor images, Tensor kernel, bool transposed) -> Tensor",
    reference=_blur,
    fake=lambda images, kernel, transposed: torch.empty_like(images),
)

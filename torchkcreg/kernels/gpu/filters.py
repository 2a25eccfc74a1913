"""Separable filters in Triton: one program per block of pixels, one axis at a time."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_PIXELS = 256  # per program


@triton.jit
def _along(
    images, kernel, result, count, size, step, images_of_kernel, TAPS: tl.constexpr, TRANSPOSED: tl.constexpr,
    PIXELS: tl.constexpr,
):  # fmt: skip
    """Filter along an axis of `size` pixels, `step` elements apart, with the border repeated; or the transpose."""
    pixel = tl.program_id(0).to(tl.int64) * PIXELS + tl.arange(0, PIXELS)
    there = pixel < count
    i = (pixel // step) % size
    RADIUS: tl.constexpr = TAPS // 2
    taps = kernel + pixel // images_of_kernel * TAPS
    total = tl.zeros([PIXELS], dtype=images.dtype.element_ty)
    for tap in range(TAPS):
        if TRANSPOSED:
            other = i - tap + RADIUS
            use = there & (other >= 0) & (other < size)
        else:
            other = tl.minimum(tl.maximum(i + tap - RADIUS, 0), size - 1)
            use = there
        value = tl.load(images + pixel + (other - i) * step, mask=use, other=0.0)
        total += value * tl.load(taps + tap, mask=there, other=0.0)
    if TRANSPOSED:  # contributions beyond an end go to its last pixel
        for far in range(RADIUS):
            before = there & (i == 0) & (i + far < size)
            behind = there & (i == size - 1) & (i - far >= 0)
            first = tl.load(images + pixel + far * step, mask=before, other=0.0)
            last = tl.load(images + pixel - far * step, mask=behind, other=0.0)
            for tap in range(RADIUS - far):
                total += first * tl.load(taps + tap, mask=before, other=0.0)
                total += last * tl.load(taps + TAPS - 1 - tap, mask=behind, other=0.0)
    tl.store(result + pixel, total, mask=there)


def filtered(images: Tensor, kernel: Tensor, *, transposed: bool = False, axes: tuple[int, ...] = (-2, -1)) -> Tensor:
    """Images (B, ..., rows, cols) filtered along rows and columns, or one of them, with one kernel per element of B."""
    images, kernel = images.contiguous(), kernel.contiguous()
    pixels_per_kernel = images[0].numel() if len(images) else 1
    for axis in axes:
        size, step = images.shape[axis], images.stride(axis)
        result = torch.empty_like(images)
        if images.numel():
            _along[(triton.cdiv(images.numel(), _PIXELS),)](
                images, kernel, result, images.numel(), size, step, pixels_per_kernel,
                TAPS=kernel.shape[-1], TRANSPOSED=transposed, PIXELS=_PIXELS,
            )  # fmt: skip
        images = result
    return images


def blur(images: Tensor, kernel: Tensor, transposed: bool) -> Tensor:
    """Images (B, rows, cols) filtered by one kernel (odd,); see `torchkcreg.physics.blur`."""
    return filtered(images[None], kernel[None], transposed=transposed)[0]

"""Transmission of a beam of several energies through materials, in Triton: one program per block of pixels.

The blur is done by `filtered`, the average over sub-pixels by torch.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import avg_pool2d

from .filters import filtered

_PIXELS = 256  # per program


@triton.jit
def _passed(lengths, attenuation, energy, pixel, there, image, pixels, views, energies, MATERIALS: tl.constexpr):
    """Transmission at one energy behind all materials. `image` is candidate * views + view."""
    exponent = tl.zeros([pixel.shape[0]], dtype=lengths.dtype.element_ty)
    for m in tl.static_range(MATERIALS):
        at = lengths + ((image // views * MATERIALS + m) * views + image % views).to(tl.int64) * pixels
        exponent -= tl.load(at + pixel, mask=there, other=0.0) * tl.load(attenuation + m * energies + energy)
    return tl.exp(exponent)


@triton.jit
def _signal(
    lengths, attenuation, weights, result, pixels, views, energies, MATERIALS: tl.constexpr, PIXELS: tl.constexpr
):
    image, pixel = tl.program_id(1), tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    there = pixel < pixels
    total = tl.zeros([PIXELS], dtype=lengths.dtype.element_ty)
    for e in range(energies):
        passed = _passed(lengths, attenuation, e, pixel, there, image, pixels, views, energies, MATERIALS)
        total += passed * tl.load(weights + image * energies + e)
    tl.store(result + image.to(tl.int64) * pixels + pixel, total, mask=there)


@triton.jit
def _gradients(
    upstream, lengths, attenuation, weights, to_lengths, to_weights, moments, pixels, views, energies,
    MATERIALS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Gradients to the path lengths of a block, and its contributions to those of weights and attenuation."""
    image, pixel = tl.program_id(1), tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    there = pixel < pixels
    block = image * tl.num_programs(0) + tl.program_id(0)
    above = tl.load(upstream + image.to(tl.int64) * pixels + pixel, mask=there, other=0.0)
    for e in range(energies):
        part = _passed(lengths, attenuation, e, pixel, there, image, pixels, views, energies, MATERIALS) * above
        tl.store(to_weights + block * energies + e, tl.sum(part))
        weight = tl.load(weights + image * energies + e)
        for m in tl.static_range(MATERIALS):
            place = ((image // views * MATERIALS + m) * views + image % views).to(tl.int64) * pixels + pixel
            so_far = tl.load(to_lengths + place, mask=there, other=0.0)
            slope = weight * tl.load(attenuation + m * energies + e)
            tl.store(to_lengths + place, so_far - slope * part, mask=there)
            length = tl.load(lengths + place, mask=there, other=0.0)
            tl.store(moments + (block * MATERIALS + m) * energies + e, -weight * tl.sum(part * length))


def transmission(lengths: Tensor, attenuation: Tensor, weights: Tensor, kernel: Tensor, pooling: int) -> Tensor:
    """Images (K, V, rows, cols) after pooling; see `torchkcreg.physics.transmission`."""
    blurred = filtered(_signals(*(t.contiguous() for t in (lengths, attenuation, weights))), kernel)
    return avg_pool2d(blurred, pooling)


def transmission_backward(
    grad: Tensor,
    lengths: Tensor,
    attenuation: Tensor,
    weights: Tensor,
    kernel: Tensor,
    pooling: int,
    need_attenuation: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients to path lengths, attenuation (empty if not needed), weights and blur kernels."""
    lengths, attenuation, weights = (t.contiguous() for t in (lengths, attenuation, weights))
    candidates, materials, views, rows, cols = lengths.shape
    spread = grad.repeat_interleave(pooling, -2).repeat_interleave(pooling, -1) / pooling**2
    signal = _signals(lengths, attenuation, weights)
    to_kernel = _kernel_gradient(spread, signal, kernel)
    upstream = filtered(spread, kernel, transposed=True)
    blocks, energies = triton.cdiv(rows * cols, _PIXELS), attenuation.shape[1]
    to_lengths = torch.zeros_like(lengths)
    to_weights = lengths.new_zeros(candidates, views, blocks, energies)
    moments = lengths.new_zeros(candidates, views, blocks, materials, energies)
    if lengths.numel():
        _gradients[blocks, candidates * views](
            upstream, lengths, attenuation, weights, to_lengths, to_weights, moments, rows * cols, views, energies,
            MATERIALS=materials, PIXELS=_PIXELS,
        )  # fmt: skip
    to_attenuation = moments.sum((0, 1, 2)) if need_attenuation else lengths.new_empty(0)
    return to_lengths, to_attenuation, to_weights.sum(2), to_kernel


def _signals(lengths: Tensor, attenuation: Tensor, weights: Tensor) -> Tensor:
    """Sums over energies (K, V, rows, cols)."""
    candidates, materials, views, rows, cols = lengths.shape
    result = lengths.new_empty(candidates, views, rows, cols)
    if result.numel():
        _signal[triton.cdiv(rows * cols, _PIXELS), candidates * views](
            lengths, attenuation, weights, result, rows * cols, views, attenuation.shape[1],
            MATERIALS=materials, PIXELS=_PIXELS,
        )  # fmt: skip
    return result


def _kernel_gradient(spread: Tensor, signal: Tensor, kernel: Tensor) -> Tensor:
    """Gradient (K, odd) to the kernels of a blur along rows, then columns, whose result has the gradient `spread`."""
    radius, (rows, cols) = kernel.shape[-1] // 2, signal.shape[-2:]
    shifts = torch.arange(-radius, radius + 1, device=kernel.device)
    only_rows, only_cols = filtered(signal, kernel, axes=(-2,)), filtered(spread, kernel, transposed=True, axes=(-1,))
    gradients = []
    for shift in shifts.tolist():
        beside = (torch.arange(cols, device=kernel.device) + shift).clamp(0, cols - 1)
        above = (torch.arange(rows, device=kernel.device) + shift).clamp(0, rows - 1)
        second = (only_rows.index_select(-1, beside) * spread).sum((1, 2, 3))
        gradients.append(second + (signal.index_select(-2, above) * only_cols).sum((1, 2, 3)))
    return torch.stack(gradients, dim=-1)

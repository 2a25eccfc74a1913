"""Line integrals that a detector reports behind several materials: one fused operation with its own derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchkcreg.differentiable import differentiable
from torchkcreg.physics.blur import convolve, convolve_adjoint, convolve_by, kernel_gradient

BLOCK_PIXELS = 65536  # exponentials are taken in blocks that stay in a core's cache


def polyenergetic_line_integrals(
    path_lengths: Tensor,
    attenuation: Tensor,
    weights: Tensor,
    kernel: Tensor,
    scatter: Tensor,
    pooling: int = 1,
) -> Tensor:
    """Line integrals `(K, V, rows, cols)` of materials' path lengths `(K, M, V, rows, cols)`.

    `y = -ln(blur(sum_k w_k exp(-sum_m mu_mk L_m)) + s)`, candidate by candidate; only images of the size of the result
    are kept for the gradient, whatever the number of energies.

    Args:
        path_lengths: Path lengths in mm, `(K, M, V, rows, cols)`.
        attenuation: Attenuation coefficients in 1/mm, `(M, energies)`; no gradient.
        weights: Weights of the energies, `(K, energies)`.
        kernel: One-dimensional blur kernels, `(K, odd)`, applied along rows and columns.
        scatter: Scatter s in units of the open beam, of a shape that broadcasts to that of the result.
        pooling: Blurred transmissions are averaged over squares of this many pixels a side, which divides the images.

    Returns:
        Differentiable in everything but the attenuation: gradients by formulas of their own, all other derivatives by
        those of plain torch, which keep an image for each energy.
    """
    num_candidates, _, views, rows, cols = path_lengths.shape
    spread = scatter.to(path_lengths).expand(num_candidates, views, rows // pooling, cols // pooling)
    inputs = (path_lengths, weights, kernel, spread)
    return differentiable(_LineIntegrals(attenuation.detach(), pooling), *inputs)


@dataclass(frozen=True)
class _LineIntegrals:
    """See `polyenergetic_line_integrals`."""

    attenuation: Tensor
    pooling: int

    def forward(self, path_lengths: Tensor, weights: Tensor, kernel: Tensor, scatter: Tensor) -> Tensor:
        coefficients = self.attenuation.tolist()
        image_shape = path_lengths.shape[2:]
        result = path_lengths.new_empty(scatter.shape)
        for candidate, (shares, blur) in enumerate(zip(weights.tolist(), kernel.tolist())):
            lengths = path_lengths[candidate].flatten(1)
            signal = transmitted(lengths, coefficients, shares).view(image_shape)
            for view in range(image_shape[0]):
                blurred = _pooled(convolve(convolve(signal[view], blur, -2), blur, -1), self.pooling)
                _add_floor(blurred, scatter[candidate, view], out=result[candidate, view]).log_().neg_()
        return result

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
        path_lengths, weights, kernel, scatter = inputs
        coefficients = self.attenuation.tolist()
        wants_lengths, wants_weights, wants_kernel, wants_scatter = needed
        grad_lengths = torch.empty_like(path_lengths) if wants_lengths else None
        grad_scatter = torch.empty(scatter.shape).to(scatter) if wants_scatter else None
        grad_weights, grad_kernel = [], []
        for candidate, (shares, blur) in enumerate(zip(weights.tolist(), kernel.tolist())):
            lengths = path_lengths[candidate].flatten(1)
            signal = transmitted(lengths, coefficients, shares).view(path_lengths.shape[2:])
            along_rows = convolve(signal, blur, -2)
            blurred = _pooled(convolve(along_rows, blur, -1), self.pooling)
            total = _add_floor(blurred, scatter[candidate], out=blurred)
            grad_signal = total.reciprocal_().mul_(gradient[candidate]).neg_()
            if grad_scatter is not None:
                grad_scatter[candidate] = grad_signal
            grad_signal = _spread(grad_signal, self.pooling)
            grad_rows = convolve_adjoint(grad_signal, blur, -1)
            if wants_kernel:
                radius = len(blur) // 2
                first = kernel_gradient(signal, grad_rows, radius, -2)
                second = kernel_gradient(along_rows, grad_signal, radius, -1)
                grad_kernel.append([a + b for a, b in zip(first, second)])
            grad_signal = convolve_adjoint(grad_rows, blur, -2).flatten()
            out = grad_lengths[candidate].flatten(1) if grad_lengths is not None else None
            grad_weights.append(_transmission_gradient(lengths, coefficients, shares, grad_signal, out))
        return [
            grad_lengths,
            weights.new_tensor(grad_weights) if wants_weights else None,
            kernel.new_tensor(grad_kernel) if wants_kernel else None,
            grad_scatter,
        ]

    def reference(self, path_lengths: Tensor, weights: Tensor, kernel: Tensor, scatter: Tensor) -> Tensor:
        exponents = torch.einsum("me,kmvij->kevij", self.attenuation.to(path_lengths), path_lengths)
        signal = torch.einsum("ke,kevij->kvij", weights.to(path_lengths), torch.exp(-exponents))
        blurred = convolve_by(convolve_by(signal, kernel.to(signal), -2), kernel.to(signal), -1)
        floor = torch.finfo(signal.dtype).tiny
        return -torch.log((avg_pool2d(blurred, self.pooling) + scatter).clamp_min(floor))


def transmitted(lengths: Tensor, attenuation: list[list[float]], weights: list[float]) -> Tensor:
    """Transmitted signal `(pixels,)`, `sum_k w_k exp(-sum_m mu_mk L_m)`, of path lengths `(M, pixels)` in mm."""
    result = lengths.new_zeros(lengths.shape[1])
    for start in range(0, len(result), BLOCK_PIXELS):
        block = lengths[:, start : start + BLOCK_PIXELS]
        total = result[start : start + BLOCK_PIXELS]
        for energy, weight in enumerate(weights):
            total.add_(_attenuated(block, attenuation, energy), alpha=weight)
    return result


def _attenuated(block: Tensor, attenuation: list[list[float]], energy: int) -> Tensor:
    """`exp(-sum_m mu_m L_m)` at one energy."""
    exponent = block[0] * -attenuation[0][energy]
    for material in range(1, len(block)):
        exponent.add_(block[material], alpha=-attenuation[material][energy])
    return exponent.exp_()


def _transmission_gradient(
    lengths: Tensor, attenuation: list[list[float]], weights: list[float], upstream: Tensor, out: Tensor | None
) -> list[float]:
    """Derivatives of `<transmitted, upstream>` to the weights; those to the path lengths go into `out`."""
    grad_weights = [0.0] * len(weights)
    if out is not None:
        out.zero_()
    for start in range(0, lengths.shape[1], BLOCK_PIXELS):
        stop = start + BLOCK_PIXELS
        for energy, weight in enumerate(weights):
            passed = _attenuated(lengths[:, start:stop], attenuation, energy).mul_(upstream[start:stop])
            grad_weights[energy] += float(passed.sum())
            if out is not None:
                for material, coefficients in enumerate(attenuation):
                    out[material, start:stop].add_(passed, alpha=-weight * coefficients[energy])
    return grad_weights


def _pooled(images: Tensor, pooling: int) -> Tensor:
    """Images `(..., rows, cols)` averaged over squares of pixels."""
    return images if pooling == 1 else avg_pool2d(images.unsqueeze(0), pooling).squeeze(0)


def _spread(images: Tensor, pooling: int) -> Tensor:
    """The adjoint of `_pooled`."""
    if pooling == 1:
        return images
    return (images / pooling**2).repeat_interleave(pooling, -2).repeat_interleave(pooling, -1)


def _add_floor(signal: Tensor, floor: Tensor, *, out: Tensor) -> Tensor:
    """Signal plus floor, kept positive: a negative floor must not turn into NaN."""
    return torch.add(signal, floor, out=out).clamp_min_(torch.finfo(signal.dtype).tiny)

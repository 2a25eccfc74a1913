"""Transmission of a beam of several energies through materials, blurred and pooled, as one fused operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchkcreg.kernels import Operator, choose_backend
from torchkcreg.kernels.differentiable import differentiable

from .blur import convolve_by


def transmission(
    path_lengths: Tensor,
    attenuation: Tensor,
    weights: Tensor,
    *,
    kernel: Tensor | None = None,
    pooling: int = 1,
    backend: str = "auto",
) -> Tensor:
    """Transmitted share of the beam (K, V, rows / pooling, cols / pooling), by the Beer-Lambert law over energies.

    `T = pool(blur(sum_e w_e exp(-sum_m mu_me L_m)))`. Only images of the size of the
    result are stored for the gradient, whatever the number of energies.

    Args:
        path_lengths: Path lengths L, mm, (K, M, V, rows, cols).
        attenuation: Linear attenuation mu, 1/mm, (M, E).
        weights: Spectrum w, (E,), or spectra of views or candidates that broadcast to (K, V, E).
        kernel: Blur kernels (K, odd), applied along rows and columns with the border repeated. None: no blur.
        pooling: Edge of the squares of pixels over which blurred transmissions are averaged.
        backend: "auto", "cpp", "triton" or "torch".

    Returns:
        Tensor, differentiable in all inputs. First gradients have fast kernels; all other derivatives use plain torch,
        which stores one image per energy.

    Raises:
        ValueError: If shapes do not match.

    >>> water = torch.tensor([[0.02]])
    >>> transmission(torch.full((1, 1, 1, 1, 1), 50.0), water, torch.ones(1)).flatten()
    tensor([0.3679])
    """
    if path_lengths.dim() != 5 or attenuation.dim() != 2 or path_lengths.shape[1] != len(attenuation):
        raise ValueError(
            f"path_lengths must have shape (K, {len(attenuation)}, V, rows, cols), got {tuple(path_lengths.shape)}"
        )
    candidates, _, views, rows, cols = path_lengths.shape
    if pooling < 1 or rows % pooling or cols % pooling:
        raise ValueError(f"pooling must divide rows and cols, got {pooling} for {rows} x {cols}")
    shape = (candidates, views, attenuation.shape[1])
    try:
        spectra = weights.to(path_lengths).broadcast_to(shape)
    except RuntimeError as error:
        raise ValueError(f"weights must broadcast to (K, V, E) = {shape}, got {tuple(weights.shape)}") from error
    blur = path_lengths.new_ones(candidates, 1) if kernel is None else kernel.to(path_lengths)
    operation = _Transmission(pooling)
    inputs = (path_lengths, attenuation.to(path_lengths), spectra, blur.broadcast_to(candidates, blur.shape[-1]))
    if choose_backend(path_lengths, backend, operator=TRANSMISSION.name).is_reference:
        return operation.reference(*inputs)
    return differentiable(operation, *inputs)


@dataclass(frozen=True)
class _Transmission:
    """The operation with its non-differentiable setting."""

    pooling: int

    def forward(self, *inputs: Tensor) -> Tensor:
        return TRANSMISSION.dispatched(*inputs, self.pooling)

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
        gradients = TRANSMISSION_BACKWARD.dispatched(gradient, *inputs, self.pooling, needed[1])
        return [g if need else None for g, need in zip(gradients, needed)]

    def reference(self, path_lengths: Tensor, attenuation: Tensor, weights: Tensor, kernel: Tensor) -> Tensor:
        return _transmitted(path_lengths, attenuation, weights, kernel, self.pooling)


def _transmitted(path_lengths: Tensor, attenuation: Tensor, weights: Tensor, kernel: Tensor, pooling: int) -> Tensor:
    """Reference in plain torch."""
    exponents = torch.einsum("me,kmvij->kevij", attenuation, path_lengths)
    signal = torch.einsum("kve,kevij->kvij", weights, torch.exp(-exponents))
    return avg_pool2d(convolve_by(convolve_by(signal, kernel, -2), kernel, -1), pooling)


def _gradients(
    grad: Tensor,
    path_lengths: Tensor,
    attenuation: Tensor,
    weights: Tensor,
    kernel: Tensor,
    pooling: int,
    need_attenuation: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of the reference by autograd. The one to the attenuation is empty if it is not needed."""
    inputs = [t.detach().requires_grad_(True) for t in (path_lengths, attenuation, weights, kernel)]
    with torch.enable_grad():
        result = _transmitted(inputs[0], inputs[1], inputs[2], inputs[3], pooling)
    to_lengths, to_attenuation, to_weights, to_kernel = torch.autograd.grad(result, inputs, grad)
    return to_lengths, to_attenuation if need_attenuation else grad.new_empty(0), to_weights, to_kernel


def _fake_images(lengths: Tensor, attenuation: Tensor, weights: Tensor, kernel: Tensor, pooling: int) -> Tensor:
    candidates, _, views, rows, cols = lengths.shape
    return lengths.new_empty(candidates, views, rows // pooling, cols // pooling)


def _fake_gradients(
    grad: Tensor,
    lengths: Tensor,
    attenuation: Tensor,
    weights: Tensor,
    kernel: Tensor,
    pooling: int,
    need_attenuation: bool,
) -> tuple[Tensor, ...]:
    to_attenuation = lengths.new_empty(attenuation.shape if need_attenuation else (0,))
    return lengths.new_empty(lengths.shape), to_attenuation, *(t.new_empty(t.shape) for t in (weights, kernel))


# lengths (K, M, V, rows, cols), attenuation (M, E), weights (K, V, E), kernel (K, odd) -> (K, V, rows, cols)
TRANSMISSION = Operator(
    "transmission(Tensor lengths, Tensor attenuation, Tensor weights, Tensor kernel, int pooling) -> Tensor",
    reference=_transmitted,
    fake=_fake_images,
)
TRANSMISSION_BACKWARD = Operator(
    "transmission_backward(Tensor grad, Tensor lengths, Tensor attenuation, Tensor weights, Tensor kernel, "
    "int pooling, bool need_attenuation) -> (Tensor, Tensor, Tensor, Tensor)",
    reference=_gradients,
    fake=_fake_gradients,
)

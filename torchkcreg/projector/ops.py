"""The point-cloud DRR as a torch operator: fake kernels, autograd, and the choice of the backend.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``. They are loaded at first use, never at import.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from . import extension
from .reference import splat_points

BACKENDS = ("auto", "cpp", "torch")


def point_drr(
    points: Tensor,
    masses: Tensor,
    matrices: Tensor,
    table: Tensor,
    block_size: int,
    rows: int,
    cols: int,
    *,
    backend: str = "auto",
) -> Tensor:
    """Images (B, V, rows, cols) of nodes spread by their footprints; see `reference.splat_points` for the arguments.

    Raises:
        ValueError: for a backend that does not exist or does not serve the device of the points.
        OSError: for ``backend="cpp"`` where the kernels are neither built nor can be compiled.
    """
    if choose_backend(points, backend) == "cpp":
        return torch.ops.torchkcreg.point_drr(points, masses, matrices, table, block_size, rows, cols)
    return splat_points(points, masses, matrices, table, block_size, rows, cols)


def choose_backend(points: Tensor, backend: str) -> str:
    """The backend, "cpp" or "torch", that serves a request on the device of the points."""
    if backend == "triton":
        raise ValueError('backend "triton" is not available')
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    on_cpu = points.device.type == "cpu"
    if backend == "cpp" and not on_cpu:
        raise ValueError(f'backend "cpp" needs tensors on the CPU, got {points.device}')
    if backend == "torch" or not on_cpu:
        return "torch"
    reason = load_operators()
    if reason is None:
        return "cpp"
    if backend == "cpp":
        raise OSError(f"the C++ kernels are not available: {reason}")
    return "torch"


@functools.lru_cache(maxsize=1)
def load_operators() -> str | None:
    """None once ``torch.ops.torchkcreg`` is ready, else why it can't be."""
    reason = extension.unavailable_reason()
    if reason is None:
        torch.library.register_fake("torchkcreg::point_drr", _fake_forward)
        torch.library.register_fake("torchkcreg::point_drr_backward", _fake_backward)
        torch.library.register_autograd("torchkcreg::point_drr", _backward, setup_context=_setup_context)
    return reason


def _fake_forward(
    points: Tensor, masses: Tensor, matrices: Tensor, table: Tensor, block_size: int, rows: int, cols: int
) -> Tensor:
    return points.new_empty(points.shape[0], matrices.shape[0], rows, cols)


def _fake_backward(
    grad: Tensor,
    points: Tensor,
    masses: Tensor,
    matrices: Tensor,
    table: Tensor,
    block_size: int,
    need_masses: bool,
    need_matrices: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    return (
        points.new_empty(points.shape),
        masses.new_empty(masses.shape if need_masses else (0,)),
        matrices.new_empty(matrices.shape if need_matrices else (0,)),
    )


def _setup_context(ctx, inputs: tuple, output: Tensor) -> None:
    points, masses, matrices, table, ctx.block_size, _, _ = inputs
    ctx.save_for_backward(points, masses, matrices, table)


def _backward(ctx, grad: Tensor) -> tuple:
    need_points, need_masses, need_matrices = ctx.needs_input_grad[:3]
    grads = torch.ops.torchkcreg.point_drr_backward(
        grad, *ctx.saved_tensors, ctx.block_size, need_masses, need_matrices
    )
    needed = (need_points, need_masses, need_matrices)
    return *(g if need else None for g, need in zip(grads, needed)), None, None, None, None

"""The point-cloud DRR as a torch operator: fake kernels and autograd.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``; see `backends` for when they are loaded.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .backends import choose_backend, load_operators
from .reference import splat_points

__all__ = ["choose_backend", "load_operators", "point_drr"]


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


def register() -> None:
    """Fake kernels and autograd of the compiled operator."""
    torch.library.register_fake("torchkcreg::point_drr", _fake_forward)
    torch.library.register_fake("torchkcreg::point_drr_backward", _fake_backward)
    torch.library.register_autograd("torchkcreg::point_drr", _backward, setup_context=_setup_context)


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

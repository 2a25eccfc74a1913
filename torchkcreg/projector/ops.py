"""The point-cloud DRR as a torch operator: fake kernels and derivatives.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``; see `backends` for when they are loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.differentiable import differentiable

from .backends import choose_backend, load_operators
from .reference import splat_points

__all__ = ["choose_backend", "load_operators", "point_drr"]


def point_drr(
    points: Tensor,
    volumes: Tensor,
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
    kernel = _PointDrr(table, block_size, rows, cols)
    if choose_backend(points, backend) == "cpp":
        return differentiable(kernel, points, volumes, matrices)
    return kernel.reference(points, volumes, matrices)


@dataclass(frozen=True)
class _PointDrr:
    """The operator with what no derivative is asked of."""

    table: Tensor
    block_size: int
    rows: int
    cols: int

    def forward(self, points: Tensor, volumes: Tensor, matrices: Tensor) -> Tensor:
        return torch.ops.torchkcreg.point_drr(
            points, volumes, matrices, self.table, self.block_size, self.rows, self.cols
        )

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
        found = torch.ops.torchkcreg.point_drr_backward(gradient, *inputs, self.table, self.block_size, *needed[1:])
        return [g if need else None for g, need in zip(found, needed)]

    def reference(self, points: Tensor, volumes: Tensor, matrices: Tensor) -> Tensor:
        return splat_points(points, volumes, matrices, self.table, self.block_size, self.rows, self.cols)


def register() -> None:
    """Fake kernels of the compiled operator."""
    torch.library.register_fake("torchkcreg::point_drr", _fake_forward)
    torch.library.register_fake("torchkcreg::point_drr_backward", _fake_backward)


def _fake_forward(
    points: Tensor, volumes: Tensor, matrices: Tensor, table: Tensor, block_size: int, rows: int, cols: int
) -> Tensor:
    return points.new_empty(points.shape[0], matrices.shape[0], rows, cols)


def _fake_backward(
    grad: Tensor,
    points: Tensor,
    volumes: Tensor,
    matrices: Tensor,
    table: Tensor,
    block_size: int,
    need_volumes: bool,
    need_matrices: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    return (
        points.new_empty(points.shape),
        volumes.new_empty(volumes.shape if need_volumes else (0,)),
        matrices.new_empty(matrices.shape if need_matrices else (0,)),
    )

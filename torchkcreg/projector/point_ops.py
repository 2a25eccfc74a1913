"""The point-cloud DRR as an operator with its derivatives; kernels are in ``csrc/cpu/point_drr.cpp``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.kernels import Operator, choose_backend
from torchkcreg.kernels.differentiable import differentiable

from .point_reference import splat_points


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
        OSError: for a backend whose kernels cannot be had.
    """
    kernel = _PointDrr(table, block_size, rows, cols)
    if choose_backend(points, backend, operator=POINT_DRR.name).is_reference:
        return kernel.reference(points, volumes, matrices)
    return differentiable(kernel, points, volumes, matrices)


@dataclass(frozen=True)
class _PointDrr:
    """The operator with what no derivative is asked of."""

    table: Tensor
    block_size: int
    rows: int
    cols: int

    def forward(self, points: Tensor, volumes: Tensor, matrices: Tensor) -> Tensor:
        return POINT_DRR.dispatched(points, volumes, matrices, self.table, self.block_size, self.rows, self.cols)

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
        found = POINT_DRR_BACKWARD.dispatched(gradient, *inputs, self.table, self.block_size, *needed[1:])
        return [g if need else None for g, need in zip(found, needed)]

    def reference(self, points: Tensor, volumes: Tensor, matrices: Tensor) -> Tensor:
        return splat_points(points, volumes, matrices, self.table, self.block_size, self.rows, self.cols)


def _splat_gradients(
    grad: Tensor,
    points: Tensor,
    volumes: Tensor,
    matrices: Tensor,
    table: Tensor,
    block_size: int,
    need_volumes: bool,
    need_matrices: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of `splat_points` by autograd; one that is not needed comes back empty."""
    rows, cols = grad.shape[-2:]
    here, there, views = (t.detach().requires_grad_(True) for t in (points, volumes, matrices))
    with torch.enable_grad():
        images = splat_points(here, there, views, table, block_size, rows, cols)
    to_points, to_volumes, to_matrices = torch.autograd.grad(images, (here, there, views), grad)
    return (
        to_points,
        to_volumes if need_volumes else to_volumes.new_empty(0),
        to_matrices if need_matrices else to_matrices.new_empty(0),
    )


def _fake_images(
    points: Tensor, volumes: Tensor, matrices: Tensor, table: Tensor, block_size: int, rows: int, cols: int
) -> Tensor:
    return points.new_empty(points.shape[0], matrices.shape[0], rows, cols)


def _fake_gradients(
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


# points (B, N, 3), volumes (N,), matrices (V, 3, 4), table (V, blocks, R + 1, R + 1, T, T) -> (B, V, rows, cols)
POINT_DRR = Operator(
    "point_drr(Tensor points, Tensor volumes, Tensor matrices, Tensor table, int block_size, int rows, int cols) "
    "-> Tensor",
    reference=splat_points,
    fake=_fake_images,
)
POINT_DRR_BACKWARD = Operator(
    "point_drr_backward(Tensor grad, Tensor points, Tensor volumes, Tensor matrices, Tensor table, int block_size, "
    "bool need_volumes, bool need_matrices) -> (Tensor, Tensor, Tensor)",
    reference=_splat_gradients,
    fake=_fake_gradients,
)

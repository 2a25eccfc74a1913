"""Point-cloud DRR as an operator with derivatives; the C++ kernels are in `csrc/cpu/point_drr.cpp`."""

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
    """Images (B, V, rows, cols) of nodes splatted with their footprints; arguments as in `splat_points`.

    Raises:
        ValueError: The backend does not exist or does not support the points' device.
        OSError: The backend's kernels are not available.
    """
    kernel = _PointDrr(table, block_size, rows, cols)
    if choose_backend(points, backend, operator=POINT_DRR.name).is_reference:
        return kernel.reference(points, volumes, matrices)
    return differentiable(kernel, points, volumes, matrices)


@dataclass(frozen=True)
class _PointDrr:
    """The operator with its non-differentiable arguments bound."""

    table: Tensor
    block_size: int
    rows: int
    cols: int

    def forward(self, points: Tensor, volumes: Tensor, matrices: Tensor) -> Tensor:
        return POINT_DRR.dispatched(points, volumes, matrices, self.table, self.block_size, self.rows, self.cols)

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
        gradients = POINT_DRR_BACKWARD.dispatched(gradient, *inputs, self.table, self.block_size, *needed[1:])
        return [result if need else None for result, need in zip(gradients, needed)]

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
    """Gradients of `splat_points` by autograd; gradients that are not needed are empty tensors."""
    rows, cols = grad.shape[-2:]
    point_leaf, volume_leaf, matrix_leaf = (t.detach().requires_grad_(True) for t in (points, volumes, matrices))
    with torch.enable_grad():
        images = splat_points(point_leaf, volume_leaf, matrix_leaf, table, block_size, rows, cols)
    to_points, to_volumes, to_matrices = torch.autograd.grad(images, (point_leaf, volume_leaf, matrix_leaf), grad)
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

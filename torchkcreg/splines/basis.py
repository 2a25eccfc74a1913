"""Cubic B-spline basis at many points, evaluated one knot cell at a time.

All points of a knot cell (the box between eight neighbouring control points) share the same 64 control points. With
points sorted by cell, a spline is the product of a (points, 64) matrix, built block by block in cache, with a
(64, features) matrix. Nothing is gathered point by point, and no N x 64 array is stored, not even for the backward
pass. The kernel in `csrc/cpu/splines.cpp` processes the points in the same order.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchkcreg.kernels import Operator, kernel
from torchkcreg.kernels.differentiable import one_by_one

from .grid import ControlPointGrid

_POINTS_PER_BLOCK = 1024  # (64, 1024) weights stay in a core's cache
_Orders = tuple[int, int, int]


def cubic_bspline_weights(eta: Tensor) -> Tensor:
    """Weights B_0 ... B_3 of the four control points around a point, last axis of length 4 (eq. 3 of Cao et al. 2020).

    B_0 = (1 - e)^3 / 6, B_1 = (3 e^3 - 6 e^2 + 4) / 6, B_2 = (-3 e^3 + 3 e^2 + 3 e + 1) / 6, B_3 = e^3 / 6.

    Args:
        eta: Position in the knot interval, 0 to 1, in units of the spacing; any shape.

    Returns:
        Tensor of shape (..., 4); sums to 1 over the last axis.

    Example:
        >>> (6 * cubic_bspline_weights(torch.tensor(0.0))).round().tolist()
        [1.0, 4.0, 1.0, 0.0]
    """
    return torch.stack(bspline_pieces(eta), dim=-1)


def cubic_bspline_derivatives(eta: Tensor) -> Tensor:
    """Derivatives of the four weights with respect to eta, shape (..., 4), sum 0. Divide by the spacing for 1/mm.

    Args:
        eta: Position in the knot interval, 0 to 1, in units of the spacing; any shape.

    Example:
        >>> cubic_bspline_derivatives(torch.tensor(0.0)).tolist()
        [-0.5, -0.0, 0.5, 0.0]
    """
    return torch.stack(bspline_pieces(eta, 1), dim=-1)


def bspline_pieces(eta: Tensor, order: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Four weights, or their derivatives of the given order, each a tensor of the shape of `eta`.

    Args:
        eta: Position in the knot interval, any shape.
        order: Order of the derivative, 0 for the weights. Above 3 all are zero.
    """
    rest = 1 - eta
    if order == 0:
        square, rest_square = eta * eta, rest * rest
        return (
            rest * rest_square / 6,
            (3 * eta - 6) * square / 6 + 2 / 3,
            (3 * rest - 6) * rest_square / 6 + 2 / 3,
            eta * square / 6,
        )
    if order == 1:
        return -rest * rest / 2, (1.5 * eta - 2) * eta, (2 - 1.5 * rest) * rest, eta * eta / 2
    if order == 2:
        return rest, 3 * eta - 2, 3 * rest - 2, eta
    constant = torch.ones_like(eta) if order == 3 else torch.zeros_like(eta)
    return -constant, 3 * constant, -3 * constant, constant


@dataclass(frozen=True, eq=False)
class _Sorted:
    """Points sorted by their knot cell.

    Attributes:
        order: Indices (N,) of the points, sorted by cell.
        ends: End of each cell's points in `order`, (num_cells,).
    """

    order: Tensor
    ends: Tensor

    @functools.cached_property
    def blocks(self) -> list[tuple[int, Tensor]]:
        """Blocks of at most `_POINTS_PER_BLOCK` points: number of the cell and indices of the points."""
        sizes = self.ends.diff(prepend=self.ends.new_zeros(1)).tolist()
        return [
            (cell, block)
            for cell, rows in enumerate(self.order.split(sizes))
            for block in rows.split(_POINTS_PER_BLOCK)
            if len(block)
        ]


class SplineBasis:
    """Evaluates splines on a grid, and the adjoint, at fixed points.

    Args:
        grid: Control points.
        points: Points in the implant's frame, mm, shape (N, 3).
        dtype: Type of the weights. None: that of the points.

    Raises:
        ValueError: If the points do not have shape (N, 3), or one is not finite.

    Attributes:
        eta: Position of each point in its knot cell, 0 to 1, (N, 3); differentiable in the points.
        cells: Lowest index of the 64 CPs of each occupied cell, (num_cells, 3) long. Negative outside the grid.
    """

    def __init__(self, grid: ControlPointGrid, points: Tensor, dtype: torch.dtype | None = None) -> None:
        if points.ndim != 2 or points.shape[-1] != 3:
            raise ValueError(f"points must have shape (N, 3), got {tuple(points.shape)}")
        if not torch.isfinite(points.detach()).all():
            raise ValueError("points must be finite, got some that are not")
        spacing = torch.tensor(grid.spacing, dtype=points.dtype, device=points.device)
        knots = grid.to_grid(points) / spacing
        below = knots.detach().floor()
        self.eta = (knots - below).to(dtype or points.dtype)
        self.cells, self._sorted = _sort_by_cell(below.long() - 1)
        self._shape = grid.shape

    def control_points(self) -> tuple[Tensor, Tensor]:
        """Indices (num_cells, 64, 3) of the CPs of each cell, virtual ones included, and (num_cells, 64) of real CPs.

        The second tensor holds flat indices of the nearest real CP: the CP itself, or one on the border of the grid.
        """
        steps = torch.arange(4, device=self.cells.device)
        offsets = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(64, 3)
        indices = self.cells[:, None] + offsets
        nx, ny, nz = self._shape
        x, y, z = indices.unbind(-1)
        return indices, (x.clamp(0, nx - 1) * ny + y.clamp(0, ny - 1)) * nz + z.clamp(0, nz - 1)

    def evaluate(self, features: Tensor, orders: _Orders = (0, 0, 0)) -> Tensor:
        """Splines `sum_c B_c(x) features_c` at the points, shape (N, F), differentiable in points and features.

        Args:
            features: Values of the CPs of each cell, shape (num_cells, 64, F), in the basis's dtype.
            orders: Order of the derivative along each grid axis; derivatives are in units of the spacing.
        """
        return _Evaluate.apply(self.eta, features, self._sorted, orders)

    def scatter(self, values: Tensor, orders: _Orders = (0, 0, 0)) -> Tensor:
        """Adjoint of `evaluate`: `sum_n B_c(x_n) values_n` for the CPs of each cell, shape (num_cells, 64, F).

        Args:
            values: Values of the points, shape (N, F), in the basis's dtype.
            orders: As in `evaluate`.
        """
        return _Scatter.apply(self.eta, values, self._sorted, orders, len(self.cells))

    def gradients(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield for each block of points in a cell: cell, indices of the points (n,), and d B_c / d eta (64, 3, n)."""
        along = [_Workspace(self.eta.detach(), orders) for orders in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
        for cell, rows in self._sorted.blocks:
            yield cell, rows, torch.stack([weights(rows) for weights in along], dim=1)


class _Splines(torch.autograd.Function):
    """Splines at points eta (N, 3), linear in the values of the CPs or of the points."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        eta, data, ctx.points, ctx.orders, *ctx.sizes = inputs
        ctx.save_for_backward(eta, data)
        ctx.save_for_forward(eta, data)


class _Evaluate(_Splines):
    @staticmethod
    def forward(eta: Tensor, features: Tensor, points: _Sorted, orders: _Orders) -> Tensor:
        return kernel(SPLINE_EVALUATE, eta, "auto")(eta, features, points.order, points.ends, *orders)

    @staticmethod
    def jvp(ctx: Any, along: Tensor | None, tangent: Tensor | None, *_: None) -> Tensor:
        eta, features = ctx.saved_tensors
        total = features.new_zeros(())
        if tangent is not None:
            total = total + _Evaluate.apply(eta, tangent, ctx.points, ctx.orders)
        if along is not None:
            slopes = [_Evaluate.apply(eta, features, ctx.points, o) for o in _steeper(ctx.orders)]
            total = total + sum(along[:, a : a + 1] * slope for a, slope in enumerate(slopes))
        return total

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *inputs: Any) -> tuple:
        return one_by_one(_Evaluate.apply, info, in_dims, inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        eta, features = ctx.saved_tensors
        grad_eta = _slope(eta, features, grad, ctx) if ctx.needs_input_grad[0] else None
        grad_features = None
        if ctx.needs_input_grad[1]:
            grad_features = _Scatter.apply(eta, grad, ctx.points, ctx.orders, len(features))
        return grad_eta, grad_features, None, None


class _Scatter(_Splines):
    @staticmethod
    def forward(eta: Tensor, values: Tensor, points: _Sorted, orders: _Orders, num_cells: int) -> Tensor:
        out = values.new_zeros(num_cells, 64, values.shape[-1])
        weights = _Workspace(eta, orders)
        for cell, rows in points.blocks:
            out[cell].addmm_(weights(rows), values[rows])
        return out

    @staticmethod
    def jvp(ctx: Any, along: Tensor | None, tangent: Tensor | None, *_: None) -> Tensor:
        eta, values = ctx.saved_tensors
        total = values.new_zeros(())
        if tangent is not None:
            total = total + _Scatter.apply(eta, tangent, ctx.points, ctx.orders, *ctx.sizes)
        if along is not None:
            for a, orders in enumerate(_steeper(ctx.orders)):
                total = total + _Scatter.apply(eta, along[:, a : a + 1] * values, ctx.points, orders, *ctx.sizes)
        return total

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *inputs: Any) -> tuple:
        return one_by_one(_Scatter.apply, info, in_dims, inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        eta, values = ctx.saved_tensors
        grad_eta = _slope(eta, grad, values, ctx) if ctx.needs_input_grad[0] else None
        grad_values = None
        if ctx.needs_input_grad[1]:
            grad_values = _Evaluate.apply(eta, grad, ctx.points, ctx.orders)
        return grad_eta, grad_values, None, None, None


def _slope(eta: Tensor, features: Tensor, values: Tensor, ctx: Any) -> Tensor:
    """Gradient (N, 3) with respect to eta of `sum_n values_n . spline(x_n)`; derivatives are splines again."""
    slopes = (_Evaluate.apply(eta, features, ctx.points, o) for o in _steeper(ctx.orders))
    return torch.stack([(values * slope).sum(-1) for slope in slopes], dim=-1)


def _steeper(orders: _Orders) -> list[_Orders]:
    """Orders of the next higher derivatives along each axis."""
    x, y, z = orders
    return [(x + 1, y, z), (x, y + 1, z), (x, y, z + 1)]


class _Workspace:
    """Weights of blocks of points, in memory that is allocated once and reused.

    Allocating it anew for each block would take longer than the arithmetic.
    """

    def __init__(self, eta: Tensor, orders: _Orders) -> None:
        self.eta, self.orders = eta, orders
        self.pairs, self.weights = eta.new_empty(16 * _POINTS_PER_BLOCK), eta.new_empty(64 * _POINTS_PER_BLOCK)

    def __call__(self, rows: Tensor) -> Tensor:
        """Weights (64, n) of n points, with the x offset slowest, valid until the next call.

        Points are the last axis, so that the products vectorise over them.
        """
        eta, n = self.eta[rows].T.contiguous(), len(rows)
        x, y, z = (torch.stack(bspline_pieces(e, o)) for e, o in zip(eta, self.orders, strict=True))
        pairs = torch.mul(x[:, None], y, out=self.pairs[: 16 * n].view(4, 4, n))
        return torch.mul(pairs[:, :, None], z, out=self.weights[: 64 * n].view(4, 4, 4, n)).view(64, n)


def _sort_by_cell(lowest: Tensor) -> tuple[Tensor, _Sorted]:
    """Occupied cells (num_cells, 3) and the points sorted by cell."""
    if len(lowest) == 0:
        return lowest, _Sorted(lowest[:, 0], lowest[:, 0])
    start = lowest.amin(0)
    extent = (lowest.amax(0) - start + 1).tolist()
    x, y, z = (lowest - start).unbind(-1)
    key, order = torch.sort((x * extent[1] + y) * extent[2] + z, stable=True)
    _, counts = torch.unique_consecutive(key, return_counts=True)
    ends = counts.cumsum(0)
    return lowest[order[ends - counts]], _Sorted(order, ends)


def _evaluated(eta: Tensor, features: Tensor, order: Tensor, ends: Tensor, x: int, y: int, z: int) -> Tensor:
    """Reference in plain torch."""
    weights, size = _Workspace(eta, (x, y, z)), features.shape[-1]
    out, block = features.new_empty(len(eta), size), features.new_empty(_POINTS_PER_BLOCK, size)
    for cell, rows in _Sorted(order, ends).blocks:
        out.index_copy_(0, rows, torch.mm(weights(rows).T, features[cell], out=block[: len(rows)]))
    return out


# eta (N, 3), features (num_cells, 64, F), order (N,), ends (num_cells,), orders of the derivative -> (N, F)
SPLINE_EVALUATE = Operator(
    "spline_evaluate(Tensor eta, Tensor features, Tensor order, Tensor ends, int x, int y, int z) -> Tensor",
    reference=_evaluated,
    fake=lambda eta, features, order, ends, x, y, z: features.new_empty(eta.shape[0], features.shape[2]),
)

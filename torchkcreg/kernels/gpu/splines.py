"""Cubic B-splines at scattered points in Triton: one program per block of points and feature."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_POINTS = 128  # per program


@triton.jit
def _piece(eta, number: tl.constexpr, ORDER: tl.constexpr):
    """One of the four pieces of the B-spline on a knot interval, or its derivative; see `bspline_pieces`."""
    mirrored: tl.constexpr = number >= 2
    e = 1.0 - eta if mirrored else eta  # pieces 2 and 3 are pieces 1 and 0 of 1 - eta
    rest = 1.0 - e
    outer: tl.constexpr = number == 0 or number == 3
    sign: tl.constexpr = -1.0 if mirrored and ORDER % 2 == 1 else 1.0
    if ORDER == 0:
        value = rest * rest * rest / 6.0 if outer else (3.0 * e - 6.0) * e * e / 6.0 + 2.0 / 3.0
    elif ORDER == 1:
        value = -rest * rest / 2.0 if outer else (1.5 * e - 2.0) * e
    elif ORDER == 2:
        value = rest if outer else 3.0 * e - 2.0
    elif ORDER == 3:
        value = e * 0.0 - 1.0 if outer else e * 0.0 + 3.0
    else:
        value = e * 0.0
    return sign * value


@triton.jit
def _evaluate(
    eta, features, cells, result, count, values,
    X: tl.constexpr, Y: tl.constexpr, Z: tl.constexpr, POINTS: tl.constexpr,
):  # fmt: skip
    point = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    there = point < count
    x = tl.load(eta + point * 3, mask=there, other=0.0)
    y = tl.load(eta + point * 3 + 1, mask=there, other=0.0)
    z = tl.load(eta + point * 3 + 2, mask=there, other=0.0)
    at = features + tl.load(cells + point, mask=there, other=0) * 64 * values + tl.program_id(1)
    total = tl.zeros([POINTS], dtype=eta.dtype.element_ty)
    for i in tl.static_range(4):
        for j in tl.static_range(4):
            weight = _piece(x, i, X) * _piece(y, j, Y)
            for k in tl.static_range(4):
                value = tl.load(at + ((i * 4 + j) * 4 + k) * values, mask=there, other=0.0)
                total += weight * _piece(z, k, Z) * value
    tl.store(result + point * values + tl.program_id(1), total, mask=there)


def spline_evaluate(eta: Tensor, features: Tensor, order: Tensor, ends: Tensor, x: int, y: int, z: int) -> Tensor:
    """Splines (N, F) at points; see `torchkcreg.splines.basis`."""
    eta, features = eta.contiguous(), features.contiguous()
    result = features.new_empty(len(eta), features.shape[2])
    if result.numel():
        places = torch.arange(len(order), device=order.device)
        cells = torch.empty_like(order)
        cells[order] = torch.searchsorted(ends, places, right=True)
        _evaluate[triton.cdiv(len(eta), _POINTS), features.shape[2]](
            eta, features, cells, result, len(eta), features.shape[2], X=x, Y=y, Z=z, POINTS=_POINTS
        )
    return result

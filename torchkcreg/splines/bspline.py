"""The cubic B-spline: its four pieces on a knot interval, and their derivatives."""

from __future__ import annotations

import torch
from torch import Tensor


def cubic_bspline_weights(eta: Tensor) -> Tensor:
    """Weights B_0 ... B_3 of the four control points around a point, last axis of length 4 (eq. 3 of Cao et al. 2020).

    B_0 = (1 - e)^3 / 6, B_1 = (3 e^3 - 6 e^2 + 4) / 6, B_2 = (-3 e^3 + 3 e^2 + 3 e + 1) / 6, B_3 = e^3 / 6.

    Args:
        eta: position in the knot interval, 0 to 1, in units of the spacing; any shape.

    Returns:
        Tensor of shape (..., 4); sums to 1.

    Example:
        >>> (6 * cubic_bspline_weights(torch.tensor(0.0))).round().tolist()
        [1.0, 4.0, 1.0, 0.0]
    """
    return torch.stack(bspline_pieces(eta), dim=-1)


def cubic_bspline_derivatives(eta: Tensor) -> Tensor:
    """Derivatives of the four weights by eta, shape (..., 4); they sum to 0. Divide by the spacing for 1/mm.

    Args:
        eta: position in the knot interval, 0 to 1, in units of the spacing; any shape.

    Example:
        >>> cubic_bspline_derivatives(torch.tensor(0.0)).tolist()
        [-0.5, -0.0, 0.5, 0.0]
    """
    return torch.stack(bspline_pieces(eta, 1), dim=-1)


def bspline_pieces(eta: Tensor, order: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four weights, or their derivatives of the given order, one tensor of the shape of `eta` each.

    Args:
        eta: position in the knot interval, any shape.
        order: of the derivative, from 0 on; beyond 3 all are zero.
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
    one = torch.ones_like(eta) if order == 3 else torch.zeros_like(eta)
    return -one, 3 * one, -3 * one, one

"""The cubic B-spline's pieces."""

import pytest
import torch
from scipy.interpolate import BSpline

from torchkcreg.splines import cubic_bspline_derivatives, cubic_bspline_weights
from torchkcreg.splines.basis import bspline_pieces

ETA = torch.linspace(0, 1, 41, dtype=torch.float64)


def test_weights_are_a_partition_of_unity_and_not_negative():
    weights = cubic_bspline_weights(ETA)
    assert weights.shape == (41, 4)
    assert torch.allclose(weights.sum(-1), torch.ones_like(ETA), atol=1e-15)
    assert (weights >= 0).all()


def test_weights_reproduce_the_position():
    steps = torch.arange(-1.0, 3.0, dtype=torch.float64)
    assert torch.allclose((cubic_bspline_weights(ETA) * steps).sum(-1), ETA, atol=1e-15)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_pieces_and_derivatives_are_those_of_scipys_cardinal_spline(order):
    spline = BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)
    for offset, piece in zip((-1, 0, 1, 2), bspline_pieces(ETA[1:-1], order), strict=True):
        expected = spline((ETA[1:-1] - offset).numpy(), nu=order)
        torch.testing.assert_close(piece, torch.from_numpy(expected), atol=1e-14, rtol=0)


def test_the_fourth_derivative_vanishes():
    assert all((piece == 0).all() for piece in bspline_pieces(ETA, 4))


def test_derivatives_are_those_of_autograd():
    eta = ETA.clone().requires_grad_()
    for index in range(4):
        (slope,) = torch.autograd.grad(cubic_bspline_weights(eta)[:, index].sum(), eta)
        assert torch.allclose(cubic_bspline_derivatives(eta)[:, index], slope, atol=1e-15)


def test_pieces_join_smoothly_at_the_knots():
    for order in range(3):
        start, end = bspline_pieces(ETA[:1], order), bspline_pieces(ETA[-1:], order)
        assert torch.allclose(torch.stack(start[:3]), torch.stack(end[1:]), atol=1e-15)
        assert start[3] == 0 and end[0] == 0

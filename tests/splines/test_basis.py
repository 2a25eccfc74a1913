"""The B-spline basis, bucketed by knot cell."""

import pytest
import torch

from torchkcreg.kernels import kernel
from torchkcreg.splines import ControlPointGrid, cubic_bspline_weights
from torchkcreg.splines.basis import _POINTS_PER_BLOCK, SPLINE_EVALUATE, SplineBasis

GRID = ControlPointGrid((5, 6, 7), (2.0, 3.0, 4.0), torch.eye(4))

evaluate = kernel(SPLINE_EVALUATE, torch.zeros(0, device="cpu"), "cpp")


def scattered(count, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([8.0, 15.0, 24.0], dtype=dtype)
    return (torch.rand(count, 3, generator=generator, dtype=dtype) * 2 - 0.5) * size


def dense_weights(points):
    """The textbook's way: 64 weights and indices a point, (N, 64) and (N, 64, 3)."""
    a = points / torch.tensor(GRID.spacing, dtype=points.dtype)
    x, y, z = cubic_bspline_weights(a - a.floor()).unbind(1)
    weights = torch.einsum("nl,nm,nk->nlmk", x, y, z).reshape(len(points), 64)
    offsets = torch.cartesian_prod(*[torch.arange(4)] * 3)
    return weights, (a.floor().long() - 1)[:, None] + offsets


def test_evaluation_is_the_sum_over_64_control_points():
    points = scattered(300)
    basis = SplineBasis(GRID, points)
    indices, _ = basis.control_points()
    weights, expected_indices = dense_weights(points)
    values = torch.sin(indices.double() @ torch.tensor([[1.0, 0.3], [0.7, 2.0], [0.2, 1.1]], dtype=torch.float64))
    expected = torch.sin(
        expected_indices.double() @ torch.tensor([[1.0, 0.3], [0.7, 2.0], [0.2, 1.1]], dtype=torch.float64)
    )
    assert torch.allclose(basis.evaluate(values), (weights[..., None] * expected).sum(1), atol=1e-12)


def test_cells_with_more_points_than_a_block_are_evaluated_in_parts():
    points = 4 + torch.rand(_POINTS_PER_BLOCK + 7, 3, dtype=torch.float64)
    basis = SplineBasis(GRID, points)
    assert len(basis.cells) < 9
    assert torch.allclose(basis.evaluate(torch.ones(len(basis.cells), 64, 1, dtype=torch.float64)), points.new_ones(1))


@pytest.mark.parametrize("values", (1, 2, 3, 4, 7))
@pytest.mark.parametrize("orders", ((0, 0, 0), (1, 0, 2), (3, 0, 0), (0, 4, 1)))
@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
def test_the_kernel_is_the_reference_for_every_derivative_and_number_of_values(dtype, orders, values):
    basis = SplineBasis(GRID, scattered(700, dtype=dtype))
    generator = torch.Generator().manual_seed(values)
    features = torch.rand(len(basis.cells), 64, values, generator=generator, dtype=dtype)
    inputs = (basis.eta, features, basis._sorted.order, basis._sorted.ends, *orders)
    close = {"rtol": 1e-5, "atol": 2e-6} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(evaluate(*inputs), SPLINE_EVALUATE.reference(*inputs), **close)


def test_the_kernel_refuses_what_does_not_fit():
    basis = SplineBasis(GRID, scattered(20))
    order, ends = basis._sorted.order, basis._sorted.ends
    features = torch.rand(len(basis.cells), 64, 3, dtype=torch.float64)
    with pytest.raises(RuntimeError, match="features must have shape"):
        evaluate(basis.eta, features[:, :27], order, ends, 0, 0, 0)
    with pytest.raises(RuntimeError, match="the last cell must end with the last point"):
        evaluate(basis.eta, features, order, ends - 1, 0, 0, 0)
    with pytest.raises(RuntimeError, match="of one dtype"):
        evaluate(basis.eta, features.float(), order, ends, 0, 0, 0)


def test_scatter_is_the_adjoint_of_evaluate():
    basis = SplineBasis(GRID, scattered(200))
    features = torch.rand(len(basis.cells), 64, 2, dtype=torch.float64)
    values = torch.rand(200, 2, dtype=torch.float64)
    for orders in ((0, 0, 0), (1, 0, 2)):
        left = (basis.evaluate(features, orders) * values).sum()
        assert torch.allclose(left, (features * basis.scatter(values, orders)).sum(), rtol=1e-12)


def test_virtual_control_points_name_the_nearest_real_one():
    basis = SplineBasis(GRID, torch.tensor([[-100.0, 7.0, 9.0]]))
    indices, nearest = basis.control_points()
    assert (indices[..., 0] < -40).all()
    real = torch.stack([nearest // 42, nearest // 7 % 6, nearest % 7], -1)
    assert (real[..., 0] == 0).all()
    assert torch.equal(real[..., 1:], indices[..., 1:])


def test_first_and_second_derivatives_pass_gradcheck():
    points = scattered(12).requires_grad_()
    cells = len(SplineBasis(GRID, points).cells)
    features = torch.rand(cells, 64, 2, dtype=torch.float64, requires_grad=True)
    values = torch.rand(12, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, f: SplineBasis(GRID, p).evaluate(f), (points, features), fast_mode=True)
    assert torch.autograd.gradgradcheck(
        lambda p, f: SplineBasis(GRID, p).evaluate(f), (points, features), fast_mode=True
    )
    assert torch.autograd.gradcheck(lambda p, v: SplineBasis(GRID, p).scatter(v), (points, values), fast_mode=True)


def test_no_points_give_nothing():
    basis = SplineBasis(GRID, torch.zeros(0, 3))
    assert basis.evaluate(torch.zeros(0, 64, 5)).shape == (0, 5)


@pytest.mark.parametrize("points", [torch.zeros(3), torch.zeros(2, 2), torch.tensor([[0.0, torch.inf, 0.0]])])
def test_points_that_are_none_are_refused(points):
    with pytest.raises(ValueError, match="points must"):
        SplineBasis(GRID, points)

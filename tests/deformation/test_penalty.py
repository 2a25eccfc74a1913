"""The diffusion penalty."""

import math

import pytest
import torch

from torchkcreg.deformation import diffusion_penalty, without_rigid
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.splines import ControlPointGrid

GRID = ControlPointGrid((6, 5, 8), (8.75, 7.0, 25.0), torch.eye(4))


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


def rigid_phi(rotation, translation):
    positions = GRID.positions().reshape(-1, 3)
    motion = rigid_matrix(torch.tensor(rotation).double(), torch.tensor(translation).double())
    return (transform_points(motion, positions) - positions).reshape(*GRID.shape, 3)


def test_rigid_motions_cost_nothing():
    one_degree = rigid_phi([math.radians(1.0), 0.0, 0.0], [0.0, 0.0, 0.0])
    large = rigid_phi([0.9, -0.8, 0.3], [10.0, 20.0, -30.0])
    costs = diffusion_penalty(torch.stack([one_degree, large]), GRID)
    assert costs.shape == (2,) and (costs < 1e-20).all()
    assert diffusion_penalty(one_degree, GRID, remove_rigid=False) > 0.5


def test_a_shear_costs_its_slope_squared_over_the_differences_inside():
    phi = torch.zeros(*GRID.shape, 3, dtype=torch.float64)
    phi[..., 0] = 0.02 * GRID.positions()[..., 2]
    expected = 0.02**2 * (7 / 8) * 8.75 * 7.0 * 25.0
    assert float(diffusion_penalty(phi, GRID, remove_rigid=False)) == pytest.approx(expected)
    assert diffusion_penalty(phi, GRID) < expected


def test_a_checkerboard_is_not_free():
    i, j, k = torch.meshgrid(*(torch.arange(n) for n in GRID.shape), indexing="ij")
    board = (-1.0) ** (i + j + k)[..., None] * torch.ones(3)
    assert diffusion_penalty(0.1 * board.double(), GRID) > 1


def test_it_grows_with_the_square_of_a_small_deformation():
    phi = 1e-4 * random(*GRID.shape, 3)
    ratio = diffusion_penalty(2 * phi, GRID) / diffusion_penalty(phi, GRID)
    assert float(ratio) == pytest.approx(4.0, rel=1e-3)


def test_a_rigid_motion_on_top_changes_nothing():
    phi = random(*GRID.shape, 3)
    positions = GRID.positions().reshape(-1, 3)
    motion = rigid_matrix(torch.tensor([0.2, 0.1, -0.4]).double(), torch.tensor([5.0, 0.0, 1.0]).double())
    moved = (transform_points(motion, positions + phi.reshape(-1, 3)) - positions).reshape(phi.shape)
    assert torch.allclose(diffusion_penalty(moved, GRID), diffusion_penalty(phi, GRID), rtol=1e-9)
    assert torch.allclose(without_rigid(moved, GRID), without_rigid(phi, GRID), atol=1e-9)


def test_candidates_are_independent():
    phi = random(2, 3, *GRID.shape, 3)
    costs = diffusion_penalty(phi, GRID)
    assert costs.shape == (2, 3)
    assert torch.allclose(costs[1, 2], diffusion_penalty(phi[1, 2], GRID))


@pytest.mark.parametrize("remove_rigid", [False, True])
def test_gradients_pass_gradcheck(remove_rigid):
    grid = ControlPointGrid((4, 4, 4), (2.0, 3.0, 4.0), torch.eye(4))
    phi = random(2, *grid.shape, 3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p: diffusion_penalty(p, grid, remove_rigid=remove_rigid), phi, fast_mode=True
    )


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="control_points must have shape"):
        diffusion_penalty(torch.zeros(6, 6, 10, 3), GRID)

"""Rigidly moving groups of control points."""

import pytest
import torch

from torchkcreg.deformation import (
    FreeFormDeformation,
    cluster_control_points,
    control_points_from_groups,
    group_centers,
    group_moment_gradients,
    group_moments,
    moment_features,
    motion_coefficients,
)
from torchkcreg.geometry import rigid_matrix, rotation_from_vector, transform_points
from torchkcreg.splines import ControlPointGrid, group_rigid_motions

POSE = rigid_matrix(
    torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([30.0, -5.0, 11.0], dtype=torch.float64)
)
GRID = ControlPointGrid((5, 5, 8), (8.75, 7.0, 25.0), POSE)
FOUR = cluster_control_points(GRID, torch.ones(GRID.shape), 4)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


def motions(*shape):
    return rotation_from_vector(0.3 * random(*shape, 3)), 4 * random(*shape, 3, seed=1)


def around(count=150):
    """Points in the grid and as far again around it, in the implant's frame."""
    return transform_points(POSE, (0.5 + 2 * random(count, 3, seed=2)) * GRID.positions()[-1, -1, -1])


def test_shares_sum_to_one_and_first_moments_to_the_position_everywhere():
    points, centers = around(), group_centers(GRID, FOUR)
    shares, moments = group_moments(GRID, FOUR, points)
    assert shares.shape == (150, 4) and moments.shape == (150, 4, 3)
    assert torch.allclose(shares.sum(-1), points.new_ones(150), atol=1e-12)
    assert torch.allclose((moments + shares[..., None] * centers).sum(1), GRID.to_grid(points), atol=1e-9)


def test_displacements_from_moments_are_those_of_the_spline_inside_and_beyond():
    rotations, translations = motions(4)
    phi = control_points_from_groups(GRID, FOUR, rotations, translations)
    points = around()
    u = GRID.to_implant(moment_features(GRID, FOUR, points) @ motion_coefficients(rotations, translations))
    assert torch.allclose(u, FreeFormDeformation(GRID, phi, FOUR).displacement(points), atol=1e-9)
    assert not GRID.contains(points).all() and GRID.contains(points).any()


def test_control_points_turn_about_the_centre_of_their_group():
    rotations, translations = motions(4)
    phi = control_points_from_groups(GRID, FOUR, rotations, translations)
    member = (FOUR == 2).nonzero()[3]
    here, center = GRID.positions()[tuple(member)], group_centers(GRID, FOUR)[2]
    expected = rotations[2] @ (here - center) + center + translations[2] - here
    assert torch.allclose(phi[tuple(member)], expected, atol=1e-12)


def test_the_groups_motions_are_recovered_from_their_control_points():
    rotations, translations = motions(4)
    fitted = group_rigid_motions(GRID, control_points_from_groups(GRID, FOUR, rotations, translations), FOUR)
    centers = group_centers(GRID, FOUR)
    assert torch.allclose(fitted[:, :3, :3], rotations, atol=1e-9)
    moved = transform_points(fitted, centers[:, None])[:, 0]
    assert torch.allclose(moved, centers + translations, atol=1e-9)


@pytest.mark.parametrize("leading", [(), (1,), (5,), (2, 3)])
def test_candidates_are_worked_on_together(leading):
    rotations, translations = motions(*leading, 4)
    shares, moments = group_moments(GRID, FOUR, around(30))
    u = moment_features(GRID, FOUR, around(30)) @ motion_coefficients(rotations, translations)
    phi = control_points_from_groups(GRID, FOUR, rotations, translations)
    assert u.shape == (*leading, 30, 3) and phi.shape == (*leading, *GRID.shape, 3)
    last = tuple(n - 1 for n in leading)
    turn = rotations[last] - torch.eye(3)
    expected = shares @ translations[last] + torch.einsum("gij,ngj->ni", turn, moments)
    assert torch.allclose(u[last], expected, atol=1e-12)


def test_gradients_reach_motions_and_points():
    rotations, translations = motions(2, 4)
    features = moment_features(GRID, FOUR, around(6))
    assert torch.autograd.gradcheck(
        lambda r, t: features @ motion_coefficients(r, t),
        (rotations.requires_grad_(), translations.requires_grad_()),
    )
    points = around(4).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: group_moments(GRID, FOUR, p), points)


def test_moments_come_in_the_dtype_that_is_asked_for():
    points = around()
    shares, moments = group_moments(GRID, FOUR, points, dtype=torch.float32)
    exact = group_moments(GRID, FOUR, points)
    assert shares.dtype == moments.dtype == torch.float32
    assert torch.allclose(shares.double(), exact[0], atol=1e-6)
    assert torch.allclose(moments.double(), exact[1], atol=1e-3, rtol=1e-5)


def test_wrong_groups_are_refused():
    with pytest.raises(ValueError, match="got none of"):
        group_centers(GRID, 2 * FOUR)
    with pytest.raises(ValueError, match="not be negative"):
        group_centers(GRID, FOUR - 1)
    with pytest.raises(ValueError, match="labels must be integers"):
        group_centers(GRID, FOUR[:-1])
    with pytest.raises(ValueError, match="5 groups"):
        group_moments(GRID, FOUR, around(3), num_groups=5)
    with pytest.raises(ValueError, match="of 4 groups"):
        control_points_from_groups(GRID, FOUR, *motions(3))


def test_gradients_of_moments_give_the_jacobian_of_the_field():
    rotations, translations = motions(4)
    points = around(20)
    slopes = group_moment_gradients(GRID, FOUR, points)
    assert slopes.shape == (20, 3, 4, 4)
    turns = rotations - torch.eye(3)
    along_grid = slopes[..., 0] @ translations + torch.einsum("gik,njgk->nji", turns, slopes[..., 1:])
    axes = POSE[:3, :3]
    phi = control_points_from_groups(GRID, FOUR, rotations, translations)
    expected = FreeFormDeformation(GRID, phi, FOUR).jacobian(points).detach()
    assert torch.allclose(torch.eye(3) + axes @ along_grid.mT @ axes.T, expected, atol=1e-9)

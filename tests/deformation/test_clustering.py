"""Clusters of control points."""

import itertools

import pytest
import torch

from torchkcreg.deformation import cluster_control_points, control_point_volumes
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.splines import ControlPointGrid, default_grid, spline_displacement

POSE = rigid_matrix(
    torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([30.0, -5.0, 11.0], dtype=torch.float64)
)


def plate(length=200.0, width=12.0, thickness=4.0):
    axes = [torch.arange(0, size + 1e-9, 1.0, dtype=torch.float64) for size in (length, width, thickness)]
    return transform_points(POSE, torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))


@pytest.fixture(scope="module")
def loaded():
    points = plate()
    grid = default_grid(points)
    return grid, points, control_point_volumes(grid, points, torch.ones(len(points)))


def test_control_points_carry_the_implants_volume_and_its_first_moment(loaded):
    grid, points, weights = loaded
    assert weights.shape == grid.shape and weights.dtype == torch.float64
    assert float(weights.sum()) == pytest.approx(len(points))
    assert torch.allclose((weights[..., None] * grid.positions()).sum((0, 1, 2)), grid.to_grid(points).sum(0))


def test_volumes_are_the_adjoint_of_the_field():
    grid = ControlPointGrid((5, 5, 6), (8.0, 8.0, 20.0), POSE)
    size = torch.tensor([[8.0, 8.0, 20.0]], dtype=torch.float64)
    points = transform_points(POSE, (1.2 + 1.6 * torch.rand(40, 3, dtype=torch.float64)) * size)
    volumes, phi = torch.rand(40, dtype=torch.float64), torch.rand(*grid.shape, 3, dtype=torch.float64)
    carried = control_point_volumes(grid, points, volumes)
    u = spline_displacement(grid, phi, points) @ POSE[:3, :3]
    assert torch.allclose((carried[..., None] * phi).sum((0, 1, 2)), volumes @ u)


def test_what_lies_beyond_the_grid_counts_to_its_border():
    grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
    carried = control_point_volumes(grid, torch.tensor([[500.0, 15.0, 15.0]]), torch.tensor([3.0]))
    assert float(carried.sum()) == pytest.approx(3.0)
    assert (carried[:-1] == 0).all()


@pytest.mark.parametrize("num_groups", [2, 3, 4, 5])
def test_a_long_plate_is_cut_across_its_length_into_slabs_of_like_length(loaded, num_groups):
    grid, _, weights = loaded
    labels = cluster_control_points(grid, weights, num_groups)
    along = labels[0, 0]
    assert (labels == along).all()
    starts = [0, *((along.diff() != 0).nonzero().flatten() + 1).tolist()]
    assert len(starts) == num_groups == len(along.unique())
    mass = torch.stack([weights[labels == g].sum() for g in range(num_groups)])
    assert mass.max() < 3 * mass.min()


def test_more_groups_refine_fewer(loaded):
    grid, _, weights = loaded
    labels = [cluster_control_points(grid, weights, n) for n in range(1, 16)]
    for coarse, fine in itertools.pairwise(labels):
        new = int(fine.max())
        changed = fine != coarse
        assert (fine[changed] == new).all() and changed.any()
        assert len(coarse[changed].unique()) == 1
        assert len(fine.unique()) == new + 1


def test_every_group_carries_implant(loaded):
    grid, _, weights = loaded
    labels = cluster_control_points(grid, weights, 12)
    assert all(weights[labels == g].sum() > 0.005 * weights.sum() for g in range(12))


def test_control_points_far_from_the_implant_join_the_nearest_group():
    grid = ControlPointGrid((6, 6, 10), (8.75, 8.75, 25.0), torch.eye(4))
    weights = torch.zeros(grid.shape)
    weights[2:4, 2:4, 3:7] = 1.0
    labels = cluster_control_points(grid, weights, 2)
    assert (labels[:, :, :5] == 0).all() and (labels[:, :, 5:] == 1).all()


def test_the_heavier_end_draws_the_cut():
    grid = ControlPointGrid((4, 4, 10), (5.0, 5.0, 10.0), torch.eye(4))
    weights = torch.ones(grid.shape)
    weights[:, :, 7:] = 20.0
    assert int((cluster_control_points(grid, weights, 2)[0, 0] == 1).sum()) < 5


def test_impossible_clusterings_are_refused(loaded):
    grid, points, weights = loaded
    with pytest.raises(ValueError, match="num_groups must be"):
        cluster_control_points(grid, weights, 0)
    with pytest.raises(ValueError, match="num_groups must be"):
        cluster_control_points(grid, weights, 10_000)
    with pytest.raises(ValueError, match="weights must be"):
        cluster_control_points(grid, -weights, 2)
    with pytest.raises(ValueError, match="weights must be"):
        cluster_control_points(grid, 0 * weights, 2)
    with pytest.raises(ValueError, match="volumes must have shape"):
        control_point_volumes(grid, points, torch.ones(3))

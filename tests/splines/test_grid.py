"""The lattice of control points."""

import math

import pytest
import torch

from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.splines import ControlPointGrid, default_grid


def box(length, width, thickness, step=1.0):
    axes = [torch.arange(0, size + 1e-9, step, dtype=torch.float64) for size in (length, width, thickness)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


POSE = rigid_matrix(
    torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([30.0, -5.0, 11.0], dtype=torch.float64)
)


def test_control_points_are_indices_times_spacing():
    grid = ControlPointGrid((4, 5, 6), (1.0, 2.0, 3.0), torch.eye(4))
    assert grid.positions().shape == (4, 5, 6, 3)
    assert grid.positions()[3, 2, 5].tolist() == [3.0, 4.0, 15.0]
    assert grid.num_control_points == 120


def test_the_default_grid_has_the_papers_shape_for_a_small_implant_and_is_centred_on_it():
    points = transform_points(POSE, box(100, 8, 4))
    grid = default_grid(points)
    assert grid.shape == (6, 6, 10)
    middle = grid.to_grid(points.mean(0, keepdim=True))[0]
    assert torch.allclose(middle, grid.positions().reshape(-1, 3).mean(0), atol=1e-9)


def test_grid_axes_are_the_principal_axes_shortest_first():
    grid = default_grid(transform_points(POSE, box(100, 12, 4)))
    turned = POSE[:3, :3].T @ grid.frame[:3, :3]  # columns: the grid's axes in the box's frame
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    assert torch.allclose(turned.abs(), expected, atol=1e-9)
    assert torch.linalg.det(grid.frame[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("size", [(100, 12, 4), (183, 20, 9), (250, 60, 30)])
def test_the_default_grid_holds_the_implant_with_one_spacing_of_margin(size):
    points = transform_points(POSE, box(*size, step=2.0))
    grid = default_grid(points)
    coordinates = grid.to_grid(points) / torch.tensor(grid.spacing, dtype=torch.float64)
    assert (coordinates >= 2 - 1e-9).all()
    assert (coordinates <= torch.tensor(grid.shape).double() - 3 + 1e-9).all()
    assert grid.contains(points).all()
    # One control point less along a grown axis would be too few.
    for axis, least in enumerate((6, 6, 10)):
        if grid.shape[axis] > least:
            extent = float(coordinates[:, axis].max() - coordinates[:, axis].min())
            assert grid.shape[axis] - 1 - 3 < extent + 2


def test_the_valid_domain_spans_control_points_1_to_n_minus_2():
    grid = ControlPointGrid((6, 6, 10), (8.75, 8.75, 25.0), POSE)
    low, high = torch.tensor([8.75, 8.75, 25.0]), torch.tensor([4 * 8.75, 4 * 8.75, 8 * 25.0])
    corners = torch.stack([low + 1e-3, high - 1e-3, low - 1e-3, high + 1e-3]).double()
    assert grid.contains(transform_points(POSE, corners)).tolist() == [True, True, False, False]
    assert grid.contains(corners.reshape(2, 2, 3)).shape == (2, 2)


def test_points_go_to_the_grid_and_vectors_come_back():
    grid = ControlPointGrid((4, 4, 4), (1.0, 1.0, 1.0), POSE)
    there = torch.rand(5, 3, dtype=torch.float64)
    assert torch.allclose(grid.to_grid(transform_points(POSE, there)), there, atol=1e-12)
    assert torch.allclose(grid.to_implant(there), there @ POSE[:3, :3].T, atol=1e-15)


@pytest.mark.parametrize(
    ("shape", "spacing", "frame", "message"),
    [
        ((3, 4, 4), (1, 1, 1), torch.eye(4), "shape must"),
        ((4, 4, 4), (1, 0, 1), torch.eye(4), "spacing must"),
        ((4, 4, 4), (1, -1, 1), torch.eye(4), "spacing must"),
        ((4, 4, 4), (1, math.inf, 1), torch.eye(4), "spacing must"),
        ((4, 4, 4), (1, 1, 1), torch.eye(3), "frame must"),
        ((4, 4, 4), (1, 1, 1), torch.diag(torch.tensor([1.0, 1, -1, 1])), "frame must"),
        ((4, 4, 4), (1, 1, 1), 2 * torch.eye(4), "frame must"),
    ],
)
def test_impossible_grids_are_refused(shape, spacing, frame, message):
    with pytest.raises(ValueError, match=message):
        ControlPointGrid(shape, spacing, frame)


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.zeros(3), torch.full((2, 3), torch.nan)])
def test_a_grid_needs_points(points):
    with pytest.raises(ValueError, match="points must"):
        default_grid(points)

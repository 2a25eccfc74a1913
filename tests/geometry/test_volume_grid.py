from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchkcreg.geometry import VolumeGrid, rotation_from_vector, transform_points

_DIRECTION = rotation_from_vector(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64))


def _grid() -> VolumeGrid:
    return VolumeGrid((5, 6, 7), (0.5, 1.0, 2.0), (10.0, -20.0, 30.0), _DIRECTION)


def test_voxels_lie_where_simpleitk_puts_them() -> None:
    grid = _grid()
    image = sitk.GetImageFromArray(np.zeros(grid.shape, dtype=np.float32))
    image.SetSpacing(grid.spacing)
    image.SetOrigin(grid.origin)
    image.SetDirection([element for row in grid.direction for element in row])
    points = grid.points(dtype=torch.float64)
    assert points.shape == (5, 6, 7, 3)
    for k, j, i in [(0, 0, 0), (4, 5, 6), (1, 0, 3), (2, 4, 1)]:
        expected = torch.tensor(image.TransformIndexToPhysicalPoint((i, j, k)), dtype=torch.float64)
        torch.testing.assert_close(points[k, j, i], expected)


def test_world_to_voxel_inverts_voxel_to_world() -> None:
    grid = _grid()
    indices = transform_points(grid.world_to_voxel, grid.points(dtype=torch.float64)[3, 2, 1][None])
    torch.testing.assert_close(indices, torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))


def test_a_centred_grid_has_its_middle_at_the_centre() -> None:
    grid = VolumeGrid.centered((4, 5, 6), (1.0, 2.0, 0.5), center=(7.0, 8.0, 9.0), direction=_DIRECTION)
    middle = grid.points(dtype=torch.float64).mean((0, 1, 2))
    torch.testing.assert_close(middle, torch.tensor([7.0, 8.0, 9.0], dtype=torch.float64))
    assert grid.size_mm == (6.0, 10.0, 2.0) and grid.voxel_volume == 1.0 and grid.num_voxels == 120


def test_equal_grids_compare_equal_whatever_they_were_built_from() -> None:
    from_numpy = VolumeGrid(np.array([2, 3, 4]), np.float32(0.5), np.zeros(3), np.eye(3))
    assert from_numpy == VolumeGrid((2, 3, 4), (0.5, 0.5, 0.5))
    assert hash(from_numpy) == hash(VolumeGrid((2, 3, 4), (0.5, 0.5, 0.5)))


@pytest.mark.parametrize(
    "options",
    [
        {"shape": (0, 1, 1)},
        {"shape": (1, 1)},
        {"spacing": (1.0, 0.0, 1.0)},
        {"spacing": (1.0, 1.0)},
        {"origin": (0.0, float("nan"), 0.0)},
        {"direction": torch.ones(3, 3)},
        {"direction": torch.eye(2)},
    ],
)
def test_what_is_no_grid_is_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        VolumeGrid(**({"shape": (2, 2, 2)} | options))

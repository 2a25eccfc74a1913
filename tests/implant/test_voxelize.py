from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from torch.autograd import gradcheck

from torchkcreg.geometry import VolumeGrid, rotation_from_vector
from torchkcreg.implant import ImplantPointCloud, voxelize_mesh, voxelize_points

_DIRECTION = rotation_from_vector(torch.tensor([0.2, 0.3, -0.4], dtype=torch.float64))


def _grid() -> VolumeGrid:
    return VolumeGrid.centered((30, 24, 28), (0.5, 0.6, 0.7), center=(1.0, 2.0, 3.0), direction=_DIRECTION)


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, 4.0).apply_translation((1.5, 2.0, 2.5))


def _centre_and_volume(fractions: torch.Tensor, grid: VolumeGrid) -> tuple[np.ndarray, float]:
    total = fractions.sum()
    center = (fractions[..., None] * grid.points(dtype=fractions.dtype)).sum((0, 1, 2)) / total
    return center.detach().numpy(), (total * grid.voxel_volume).item()


def test_a_mesh_on_a_turned_grid_keeps_volume_and_centre() -> None:
    fractions = voxelize_mesh(_ball(), _grid(), dtype=torch.float64)
    center, volume = _centre_and_volume(fractions, _grid())
    assert volume == pytest.approx(_ball().volume, rel=1e-9)
    np.testing.assert_allclose(center, [1.5, 2.0, 2.5], atol=0.01)
    assert fractions.min() >= -1e-9 and fractions.max() <= 1 + 1e-9
    distance = (_grid().points(dtype=torch.float64) - torch.tensor([1.5, 2.0, 2.5], dtype=torch.float64)).norm(dim=-1)
    assert (fractions[distance < 3.3] > 1 - 1e-9).all() and (fractions[distance > 4.7] == 0).all()


def test_a_mirrored_grid_fills_alike() -> None:
    grid = VolumeGrid.centered((10, 10, 10), 1.0)
    mirrored = VolumeGrid((10, 10, 10), 1.0, (4.5, -4.5, -4.5), torch.diag(torch.tensor([-1.0, 1.0, 1.0])))
    torch.testing.assert_close(voxelize_mesh(_ball(), mirrored), voxelize_mesh(_ball(), grid).flip(2))


def test_what_lies_outside_the_grid_is_left_out() -> None:
    whole = voxelize_mesh(_ball(), VolumeGrid.centered((20, 20, 20), 1.0))
    part = voxelize_mesh(_ball(), VolumeGrid.centered((20, 20, 20), 1.0, center=(5.0, 0.0, 0.0)))
    torch.testing.assert_close(part[:, :, :15], whole[:, :, 5:])


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_cloud_keeps_volume_and_centre_and_stays_solid_inside(factor: int) -> None:
    cloud = ImplantPointCloud.from_mesh(_ball(), 0.4, at_centroids=True, dtype=torch.float64).coarsened(factor)
    fractions = voxelize_points(cloud.points, cloud.volumes, _grid(), cell=cloud.cell)
    center, volume = _centre_and_volume(fractions, _grid())
    assert volume == pytest.approx(_ball().volume, rel=1e-9)
    np.testing.assert_allclose(center, [1.5, 2.0, 2.5], atol=1e-3)
    distance = (_grid().points(dtype=torch.float64) - torch.tensor([1.5, 2.0, 2.5], dtype=torch.float64)).norm(dim=-1)
    inside = fractions[distance < 1.5]
    assert (inside - 1).abs().max() < 0.2


def test_the_gradients_of_a_voxelised_cloud_are_right() -> None:
    grid = VolumeGrid.centered((3, 4, 5), 1.0)
    points = torch.tensor([[0.21, -0.3, 0.4], [1.1, 0.7, 0.11], [2.3, 0.1, 0.2]], dtype=torch.float64)
    volumes = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    inputs = (points.requires_grad_(), volumes.requires_grad_())
    assert gradcheck(lambda p, m: voxelize_points(p, m, grid, cell=1.5 * torch.eye(3)), inputs)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="points and volumes"):
        voxelize_points(torch.zeros(3, 3), torch.zeros(2), _grid())
    with pytest.raises(ValueError, match="mesh must be"):
        voxelize_mesh(torch.zeros(3, 3), _grid())

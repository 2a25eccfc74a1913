import math

import pytest
import torch

from torchkcreg.evaluation import cylinder_region, distance_to, region_statistics
from torchkcreg.geometry import VolumeGrid

GRID = VolumeGrid.centered((20, 40, 40), (0.5, 0.5, 1.0))


def test_a_cylinder_holds_the_voxels_of_its_volume():
    region = cylinder_region(GRID, (0, 0, -5.2), (0, 0, 5.2), 6.0)
    assert int(region.sum()) * GRID.voxel_volume == pytest.approx(math.pi * 36 * 10, rel=0.02)


def test_distances_are_in_millimetres():
    filled = torch.zeros(GRID.shape)
    filled[10, 20, 20] = 1
    distance = distance_to(filled, GRID)
    assert distance[10, 20, 24] == 2.0 and distance[13, 20, 20] == 3.0
    assert torch.isinf(distance_to(torch.zeros(GRID.shape), GRID)).all()


def test_statistics_of_a_region_against_a_reference():
    volume = torch.arange(8.0).reshape(2, 2, 2)
    region = volume < 4
    stats = region_statistics(volume, region, reference=torch.ones(2, 2, 2))
    assert stats.num_voxels == 4
    assert stats.mean == 1.5 and stats.mean_error == 0.5
    assert stats.std == stats.std_error == pytest.approx(math.sqrt(5 / 3))


def test_an_empty_region_is_refused():
    with pytest.raises(ValueError, match="at least two voxels"):
        region_statistics(torch.zeros(3), torch.zeros(3, dtype=torch.bool))

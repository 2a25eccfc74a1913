import pytest
import torch

from torchkcreg.geometry import TwoLevelGrid, VolumeGrid

COARSE = VolumeGrid.centered(
    (6, 7, 8), (1.2, 1.2, 0.6), center=(3.0, -2.0, 1.0), direction=((0, -1, 0), (1, 0, 0), (0, 0, 1))
)


def divided(*places):
    chosen = torch.zeros(COARSE.shape, dtype=torch.bool)
    for place in places:
        chosen[place] = True
    return chosen


def test_fine_voxels_fill_the_coarse_ones_that_they_divide():
    grid = TwoLevelGrid(COARSE, divided((2, 3, 4), (3, 3, 4)), 3)
    inside = grid.fine.points(dtype=torch.float64)[grid.within].reshape(-1, 3)
    centres = COARSE.points(dtype=torch.float64)[[2, 3], [3, 3], [4, 4]]
    assert len(inside) == 54
    assert torch.allclose(inside.mean(0), centres.mean(0))
    offsets = (inside - centres.mean(0)).abs().amax(0)
    assert torch.allclose(offsets, torch.tensor([0.4, 0.4, 0.5], dtype=torch.float64))


def test_an_image_comes_apart_and_together_again():
    grid = TwoLevelGrid(COARSE, divided((2, 3, 4)), 2)
    image = torch.randn(grid.shape, generator=torch.Generator().manual_seed(0)) * grid.active
    assert torch.equal(grid.join(*grid.split(image)), image)
    assert int(grid.active.sum()) == COARSE.num_voxels - 1 + 8


@pytest.mark.parametrize("factor", [2, 3])
def test_a_linear_volume_is_the_same_on_both_levels(factor):
    grid = TwoLevelGrid(COARSE, divided((2, 3, 4), (2, 4, 4)), factor)
    volume, fine = (g.points() @ torch.tensor([0.1, 0.3, -0.2]) for g in (COARSE, grid.fine))
    coarse, shown = grid.volumes(grid.divide(volume))
    assert torch.allclose(coarse, volume, atol=1e-6)
    inner = tuple(slice(factor, -factor) for _ in range(3))  # at the box's rim there is nothing to interpolate with
    assert torch.allclose(shown[inner], fine[inner], atol=1e-6)


def test_the_outermost_voxels_stay_whole():
    grid = TwoLevelGrid(COARSE, torch.ones(COARSE.shape), 2)
    assert int(grid.divided.sum()) == 4 * 5 * 6
    assert not grid.divided[0].any()


def test_what_cannot_be_divided_is_refused():
    with pytest.raises(ValueError, match="no voxel"):
        TwoLevelGrid(COARSE, divided((0, 0, 0)), 2)
    with pytest.raises(ValueError, match="factor"):
        TwoLevelGrid(COARSE, divided((2, 2, 2)), 1)
    with pytest.raises(ValueError, match="grid's shape"):
        TwoLevelGrid(COARSE, torch.ones(2, 2, 2), 2)
    with pytest.raises(ValueError, match="image must have shape"):
        TwoLevelGrid(COARSE, divided((2, 2, 2)), 2).split(torch.zeros(5))

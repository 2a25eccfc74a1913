"""Dead pixels are filled before anything is filtered."""

import pytest
import torch

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import BeamModel, fdk, filled, prepare


def slope() -> torch.Tensor:
    rows, cols = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    return (0.3 * rows + 0.1 * cols).expand(2, 12, 16).clone()


@pytest.mark.parametrize("dead", [(slice(None), slice(4, 7)), (slice(5, 6), slice(None)), (3, 8)])
def test_a_dead_column_row_or_pixel_is_interpolated(dead: tuple) -> None:
    images, mask = slope(), torch.ones(2, 12, 16, dtype=torch.bool)
    mask[(slice(None), *dead)] = False
    spoilt = torch.where(mask, images, torch.nan)
    torch.testing.assert_close(filled(spoilt, mask), images)


def test_the_border_goes_on_and_valid_pixels_stay() -> None:
    images, mask = slope(), torch.ones(2, 12, 16, dtype=torch.bool)
    mask[:, :, 14:] = False
    result = filled(images, mask)
    torch.testing.assert_close(result[:, :, 15], images[:, :, 13])
    assert torch.equal(result[mask], images[mask])
    assert filled(images, torch.ones_like(images)) is images


def test_a_pixel_without_neighbours_is_refused() -> None:
    mask = torch.ones(2, 12, 16, dtype=torch.bool)
    mask[1] = False
    with pytest.raises(ValueError, match="192 masked pixels have no valid one"):
        filled(slope(), mask)
    with pytest.raises(ValueError, match="mask must have the images' shape"):
        filled(slope(), mask[0])


def test_a_ball_behind_a_dead_column_keeps_its_value() -> None:
    """Taken at its word the column would put rings of 40 % about the axis."""
    geometry = circular_geometry(range(0, 360, 6), sad=400, sdd=600, det_shape=(24, 64), pixel_spacing=(4.0, 2.0))
    rays = geometry.rays()
    along = rays / rays.norm(dim=-1, keepdim=True)
    way = torch.tensor([4.0, 2.0, 0.0]).double() - geometry.source_positions
    near = (along * way[:, None, None]).sum(-1)
    missed = (way**2).sum(-1)[:, None, None] - near**2
    transmission = torch.exp(-2 * 0.02 * (15.0**2 - missed).clamp_min(0).sqrt()).float()
    mask = torch.ones_like(transmission)
    mask[:, :, 30] = 0
    grid = VolumeGrid.centered((3, 21, 21), 2.0)
    beam = BeamModel.monoenergetic([])
    volumes = [
        fdk(prepare(image, geometry, beam, mask=kept).line_integrals, geometry, grid)
        for image, kept in ((transmission, None), (transmission * mask, mask))
    ]
    inside = (slice(1, 2), slice(8, 14), slice(9, 15))
    assert float(volumes[0][inside].mean()) == pytest.approx(0.02, rel=0.03)
    assert float((volumes[1] - volumes[0]).abs().max()) < 0.002
    weights = prepare(transmission * mask, geometry, beam, mask=mask).weights
    assert float(weights[:, :, 30].abs().max()) == 0.0 and float(weights[:, :, 29].min()) > 0

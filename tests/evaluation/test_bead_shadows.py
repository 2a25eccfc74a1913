import math

import pytest
import torch

from torchkcreg.evaluation import bead_shadows, track_beads
from torchkcreg.geometry import calibrate, circular_geometry
from torchkcreg.simulation.solids import Cylinder, Sphere, chord_image

GEOMETRY = circular_geometry(range(0, 360, 4), sad=404, sdd=538, det_shape=(70, 90), pixel_spacing=(0.8, 0.8))
BEADS = torch.tensor([[14.0, 5.0, -9.0], [-16.0, 3.0, 11.0]], dtype=torch.float64)
DIAMETER_PX = 2.5 * 538 / 404 / 0.8


@pytest.fixture(scope="module")
def views():
    """Noisy views of two balls of 2.5 mm in a cylinder of water, with a rod along the axis."""
    generator = torch.Generator().manual_seed(0)
    cylinder = Cylinder(torch.tensor([0.0, 0.0, -60.0]), torch.tensor([0.0, 0.0, 60.0]), 22.0)
    rod = Cylinder(torch.tensor([6.0, -6.0, -60.0]), torch.tensor([6.0, -6.0, 60.0]), 2.0)
    images = []
    for matrix in GEOMETRY.projection_matrices:
        image = sum(
            value * chord_image(solid, matrix, GEOMETRY.det_shape)
            for solid, value in [(cylinder, 0.02), (rod, 0.03), *((Sphere(b, 1.25), 0.2) for b in BEADS)]
        )
        images.append(image + 0.01 * torch.randn(image.shape, generator=generator))
    return torch.stack(images)


def test_shadows_are_found_to_a_tenth_of_a_pixel(views):
    truth = GEOMETRY.project(BEADS)[0]
    expected = truth + torch.tensor([2.0, -3.0])
    found, correlations = bead_shadows(views, expected, diameter_px=DIAMETER_PX, search_px=6)
    assert (found - truth).norm(dim=-1).nanmedian() < 0.1
    assert correlations.min() >= 0 and correlations.median() > 0.9


def test_balls_are_followed_from_view_to_view_without_being_named(views):
    tracks = track_beads(views, diameter_px=DIAMETER_PX)
    assert tracks.shape == (90, 2, 2)
    truth = GEOMETRY.project(BEADS)[0]
    order = [int((truth[0] - start).norm(dim=-1).argmin()) for start in tracks[0]]
    assert sorted(order) == [0, 1]
    assert (tracks - truth[:, order]).norm(dim=-1).nanmedian() < 0.1
    assert calibrate(GEOMETRY, tracks).median_px < 0.15


def test_where_there_is_no_ball_there_is_no_shadow(views):
    nowhere = torch.full((90, 1, 2), 10.0)
    found, correlations = bead_shadows(views, nowhere, diameter_px=DIAMETER_PX, search_px=3)
    assert found.isnan().float().mean() > 0.9 and correlations[found[..., 0].isnan()].max() == 0
    unseen, _ = bead_shadows(views[:1], torch.full((1, 1, 2), math.nan), diameter_px=DIAMETER_PX)
    assert unseen.isnan().all()


def test_a_start_where_no_ball_is_and_views_without_any_are_told(views):
    with pytest.raises(ValueError, match=r"beads \[0\] of start are lost"):
        track_beads(views, diameter_px=DIAMETER_PX, start=torch.tensor([[10.0, 10.0]]))
    with pytest.raises(ValueError, match="nothing looks like a ball"):
        track_beads(torch.zeros(5, 30, 30), diameter_px=4.0)
    with pytest.raises(ValueError, match="diameter_px must be above 1"):
        bead_shadows(views, torch.zeros(90, 1, 2), diameter_px=0.5)

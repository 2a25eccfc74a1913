import math

import pytest
import torch

from torchkcreg.evaluation import find_beads
from torchkcreg.evaluation.beads import blurred_ball
from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import fdk
from torchkcreg.simulation.solids import Cylinder, Sphere

GRID = VolumeGrid.centered((60, 64, 70), 0.5, center=(3.0, -2.0, 5.0))
CENTERS = torch.tensor([[12.3, 4.15, 11.2], [-8.7, -3.3, 0.4], [3.02, -11.9, -4.6]])


def balls(centers=CENTERS, sigma=0.4, height=0.3):
    points = GRID.points(dtype=torch.float64)
    volume = torch.full(GRID.shape, 0.02, dtype=torch.float64)
    for center in centers:
        distance = (points - center).norm(dim=-1)
        volume += height * torch.from_numpy(blurred_ball(distance.numpy(), 1.0, sigma))
    return volume


def sorted_rows(points):
    return points[points[:, 0].argsort()]


def test_blurred_balls_are_found_where_they_are_under_noise():
    noise = 0.01 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(0))
    found = find_beads(balls() + noise, GRID)
    assert len(found.centers) == 3
    assert (sorted_rows(found.centers) - sorted_rows(CENTERS)).abs().max() < 0.02
    assert found.contrasts.numpy() == pytest.approx(0.3, rel=0.1)


def test_plates_and_screws_are_no_balls():
    volume = balls()
    volume[10:50, 5:8, 20:40] = 0.6
    volume[30, 40:60, 10:13] = 0.6
    found = find_beads(volume, GRID)
    assert (sorted_rows(found.centers) - sorted_rows(CENTERS)).abs().max() < 0.05


def test_a_thing_as_thick_as_a_ball_but_longer_is_none():
    rod = balls(torch.stack([torch.tensor([3.0, -2.0, 5.0 + 0.5 * step]) for step in range(-6, 7)]), height=0.1)
    assert len(find_beads(rod, GRID).centers) == 0


def test_a_blurred_ball_has_the_volume_of_the_ball():
    r = torch.linspace(0, 6, 6001, dtype=torch.float64)
    profile = torch.from_numpy(blurred_ball(r.numpy(), 1.0, 0.5))
    assert float(torch.trapezoid(4 * math.pi * r**2 * profile, r)) == pytest.approx(4 / 3 * math.pi, rel=1e-4)


def test_balls_of_a_scan_are_found_beside_a_bar():
    from torchkcreg.simulation.solids import chord_image

    geometry = circular_geometry(range(0, 200, 2), sad=404, sdd=538, det_shape=(48, 80), pixel_spacing=(0.8, 0.8))
    centers = torch.tensor([[9.31, 2.17, 3.4], [-10.2, 6.6, -4.85]])
    axis = torch.tensor([0.0, 0.0, 30.0])
    solids = [(Sphere(center, 1.0), 0.25) for center in centers] + [(Cylinder(-axis, axis, 2.0), 0.1)]
    images = torch.stack(
        [
            sum(mu * chord_image(solid, matrix, geometry.det_shape) for solid, mu in solids)
            for matrix in geometry.projection_matrices
        ]
    ).float()
    grid = VolumeGrid.centered((30, 56, 56), 0.5)
    found = find_beads(fdk(images, geometry, grid), grid, num_beads=2)
    assert (sorted_rows(found.centers) - sorted_rows(centers)).norm(dim=1).max() < 0.03


def test_too_few_balls_and_coarse_voxels_are_named():
    with pytest.raises(ValueError, match="only 3 of 4 beads"):
        find_beads(balls(), GRID, num_beads=4)
    with pytest.raises(ValueError, match="half a ball"):
        find_beads(torch.zeros(4, 4, 4), VolumeGrid((4, 4, 4), (1.5, 1.5, 1.5)))
    assert len(find_beads(torch.zeros(GRID.shape), GRID).centers) == 0

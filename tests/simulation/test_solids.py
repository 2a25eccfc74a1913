"""Solids and their chords: closed forms, misses, overlaps, motion."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.geometry import circular_geometry, rigid_matrix
from torchkcreg.simulation import Cylinder, Sphere, Tube, chord_image, chord_lengths

ORIGIN = torch.zeros(3, dtype=torch.float64)


def along(*directions: list[float]) -> torch.Tensor:
    rays = torch.tensor(directions, dtype=torch.float64)
    return rays / rays.norm(dim=-1, keepdim=True)


def test_a_sphere_is_crossed_along_its_chord():
    sphere = Sphere([0.0, 0.0, 50.0], 5.0)
    rays = along([0.0, 0.0, 1.0], [3.0, 0.0, 40.0], [10.0, 0.0, 50.0])
    nearest = 50 * 3 / math.hypot(3, 40)
    expected = [10.0, 2 * math.sqrt(25 - nearest**2), 0.0]
    assert chord_lengths(sphere, ORIGIN, rays).tolist() == pytest.approx(expected)


def test_a_cylinder_is_crossed_across_along_and_through_one_end():
    across = Cylinder([-8.0, 0.0, 50.0], [8.0, 0.0, 50.0], 3.0)
    lengthwise = Cylinder([0.0, 0.0, 40.0], [0.0, 0.0, 60.0], 3.0)
    middle, aside, beside = along([0.0, 0.0, 1.0], [0.0, 2.0, 50.0], [9.0, 0.0, 50.0])
    assert float(chord_lengths(across, ORIGIN, middle)) == pytest.approx(6.0)
    nearest = 50 * 2 / math.hypot(2, 50)
    assert float(chord_lengths(across, ORIGIN, aside)) == pytest.approx(2 * math.sqrt(9 - nearest**2))
    assert float(chord_lengths(across, ORIGIN, beside)) == 0
    assert float(chord_lengths(lengthwise, ORIGIN, middle)) == pytest.approx(20.0)
    slanted = along([2.9, 0.0, 50.0])[0]  # in by the near end, out by the side where x = 3
    slope = math.hypot(2.9, 50) / 50
    assert float(chord_lengths(lengthwise, ORIGIN, slanted)) == pytest.approx((50 * 3 / 2.9 - 40) * slope)


def test_a_tube_lacks_its_bore():
    tube = Tube([0.0, -9.0, 50.0], [0.0, 9.0, 50.0], 5.0, 3.0)
    rays = along([0.0, 0.0, 1.0], [4.0, 0.0, 50.0])
    nearest = 50 * 4 / math.hypot(4, 50)
    assert chord_lengths(tube, ORIGIN, rays).tolist() == pytest.approx([4.0, 2 * math.sqrt(25 - nearest**2)])


def test_only_what_lies_within_another_solid_counts_if_asked():
    tube = Tube([0.0, -9.0, 50.0], [0.0, 9.0, 50.0], 5.0, 3.0)
    screw = Cylinder([0.0, 0.0, 30.0], [0.0, 0.0, 51.0], 1.0)
    rays = along([0.0, 0.0, 1.0], [1.5, 0.0, 50.0])
    assert chord_lengths(tube, ORIGIN, rays, within=screw).tolist() == pytest.approx([2.0, 0.0])
    with pytest.raises(ValueError, match="without a cavity"):
        chord_lengths(screw, ORIGIN, rays, within=tube)


def test_a_moved_solid_is_crossed_by_moved_rays_alike():
    transform = rigid_matrix(torch.tensor([0.3, -0.2, 0.5]).double(), torch.tensor([1.0, 2.0, 3.0]).double())
    rays = along([0.0, 0.0, 1.0], [2.0, 1.0, 50.0])
    for solid in (
        Sphere([1.0, 0.0, 50.0], 5.0),
        Cylinder([-8.0, 3.0, 45.0], [8.0, 0.0, 55.0], 3.0),
        Tube([0.0, -9.0, 50.0], [0.0, 9.0, 50.0], 5.0, 3.0),
    ):
        moved = chord_lengths(solid.moved(transform), transform[:3, 3], rays @ transform[:3, :3].T)
        torch.testing.assert_close(moved, chord_lengths(solid, ORIGIN, rays))


def test_an_image_sums_to_the_volume():
    geometry = circular_geometry([0.0], sad=400, sdd=600, det_shape=(40, 50), pixel_spacing=(0.5, 0.5))
    matrix = geometry.projection_matrices[0]
    for solid, volume in (
        (Sphere([0.0, 1.0, 2.0], 3.0), 4 / 3 * math.pi * 27),
        (Cylinder([-0.5, -3.5, 1.5], [0.5, 3.5, -1.5], 1.5), math.pi * 2.25 * math.sqrt(59)),
    ):
        image = chord_image(solid, matrix, (40, 50), rays=4)
        # a small solid at the isocentre: chords integrated over the area that a pixel has there
        assert float(image.sum()) * (0.5 * 400 / 600) ** 2 == pytest.approx(volume, rel=2e-3)


def test_a_solid_beside_the_detector_casts_nothing():
    geometry = circular_geometry([0.0], sad=400, sdd=600, det_shape=(40, 50), pixel_spacing=(0.5, 0.5))
    image = chord_image(Sphere([0.0, 90.0, 0.0], 3.0), geometry.projection_matrices[0], (40, 50))
    assert float(image.abs().max()) == 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sphere([0.0, 0.0, 0.0], 0.0),
        lambda: Sphere([0.0, 0.0], 1.0),
        lambda: Cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0),
        lambda: Tube([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 1.0, 2.0),
    ],
)
def test_a_solid_that_is_none_is_refused(make):
    with pytest.raises(ValueError, match=r"must (be|lie)"):
        make()

"""Hardware meshes: watertight, of the size and volume asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchkcreg.simulation import hole_positions, locking_plate, locking_screws


def test_the_plate_is_closed_with_ten_holes_and_its_size():
    plate = locking_plate()
    assert plate.is_watertight
    assert plate.is_winding_consistent
    assert plate.euler_number == 2 - 2 * 10
    np.testing.assert_allclose(plate.bounds, [[-6.75, -2.3, -94], [6.75, 2.3, 94]], atol=1e-9)
    assert plate.edges_unique_length.max() < 1.6 * 2.5


def test_the_plates_volume_is_that_of_its_outline():
    fine = locking_plate(max_edge=0.4)
    holes = 10 * math.pi * 2.4**2
    end = 13.5 * 4.0 * (0.25 + 0.75 * math.pi / 4)  # a quarter straight, the rest a half ellipse
    assert fine.volume == pytest.approx(4.6 * (180 * 13.5 - holes + 2 * end), rel=1e-3)


def test_a_ray_through_each_hole_is_free():
    plate = locking_plate()
    inside = plate.contains([[0.0, 0.0, z] for z in hole_positions()] + [[0.0, 0.0, 0.0], [6.0, 0.0, 9.0]])
    assert inside.tolist() == [False] * 10 + [True, True]


@pytest.mark.parametrize(
    "wrong",
    [{"hole_radius": 7.0}, {"num_holes": 0}, {"end_margin": 100.0}, {"thickness": 0.0}, {"max_edge": -1.0}],
)
def test_an_impossible_plate_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        locking_plate(**wrong)


def test_screws_are_listed_and_meshed():
    screws = locking_screws([-63.0, 27.0])
    mesh = screws[1].mesh()
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds[:, 1:], [[-34.0, 25.0], [2.3, 29.0]], atol=2e-3)

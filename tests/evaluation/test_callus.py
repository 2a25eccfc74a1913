"""Stiffness of the tissue in a gap, from loads that are computed with a known one."""

import math

import numpy as np
import pytest

from torchkcreg.evaluation import GapLoad, callus_stiffness

LEVER, RADIUS = 18.0, 13.0
SPREAD = RADIUS**2 * (1 + 0.6**2) / 4
BENDING = 5e5  # N mm per radian of the implant


def load(stiffness: float, force: float, std: float = 0.0) -> GapLoad:
    """A fracture whose implant bends like a spring at its own place, so that the axis closes by lever times turn."""
    turn = LEVER * force / (BENDING + stiffness * (SPREAD + LEVER**2))
    return GapLoad(force, BENDING * turn, std * BENDING * turn, LEVER * turn, std * LEVER * turn, turn, std * turn)


@pytest.mark.parametrize("stiffness", [0.0, 100.0, 5000.0])
def test_a_known_stiffness_is_found_from_one_load_and_from_two(stiffness) -> None:
    for forces in ((600.0,), (300.0, 600.0)):
        found = callus_stiffness([load(stiffness, force) for force in forces], LEVER, RADIUS)
        assert found.axial == pytest.approx(stiffness, abs=1e-6 + 1e-9 * stiffness)
        assert found.bending == pytest.approx(stiffness * SPREAD * math.radians(1) / 1000, abs=1e-6)
        closing = [load(stiffness, force).closing for force in forces]
        shares = [stiffness * c / force for c, force in zip(closing, forces, strict=True)]
        assert found.shares == pytest.approx(shares, abs=1e-9)


def test_its_error_bar_is_that_of_repeated_measurements() -> None:
    rng = np.random.default_rng(0)
    true, found, stated = load(800.0, 600.0, 0.03), [], []
    for _ in range(2000):
        m, c, t = rng.normal((true.moment, true.closing, true.turn), (true.moment_std, true.closing_std, true.turn_std))
        noisy = GapLoad(true.force, m, true.moment_std, c, true.closing_std, t, true.turn_std)
        result = callus_stiffness([noisy], LEVER, RADIUS)
        found.append(result.axial)
        stated.append(result.axial_std)
    assert np.std(found) == pytest.approx(np.median(stated), rel=0.1)
    assert np.mean(np.abs(np.array(found) - 800) < 2 * np.array(stated)) == pytest.approx(0.95, abs=0.03)


def test_a_second_load_narrows_the_interval() -> None:
    one = callus_stiffness([load(500.0, 600.0, 0.05)], LEVER, RADIUS)
    two = callus_stiffness([load(500.0, 600.0, 0.05), load(500.0, 500.0, 0.05)], LEVER, RADIUS)
    assert two.axial_std < 0.8 * one.axial_std


def test_what_does_not_move_has_no_stiffness_that_could_be_measured() -> None:
    still = GapLoad(600.0, 0.0, 1.0, 0.0, 0.01, 0.0, 0.001)
    with pytest.raises(ValueError, match="does not move"):
        callus_stiffness([still], LEVER, RADIUS)
    with pytest.raises(ValueError, match="does not move"):
        callus_stiffness([], LEVER, RADIUS)


def test_a_moment_that_the_force_does_not_explain_contradicts_the_model() -> None:
    opening = GapLoad(600.0, -8000.0, 500.0, -0.3, 0.05, -0.02, 0.001)
    assert callus_stiffness([opening], LEVER, RADIUS).contradicts
    assert not callus_stiffness([load(500.0, 600.0, 0.05)], LEVER, RADIUS).contradicts
    within = GapLoad(600.0, 600 * LEVER + 300, 500.0, 0.5, 0.05, 0.03, 0.001)  # no tissue, and a noisy moment
    assert not callus_stiffness([within], LEVER, RADIUS).contradicts

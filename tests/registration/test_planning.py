"""Which views to take: expected errors before there are images."""

import itertools

import pytest
import torch
from small_scene import RIGID, plate

from torchkcreg.geometry import circular_geometry
from torchkcreg.registration import RegistrationConfig, build_scene, view_information

ANGLES = [0.0, 1.0, 2.0, 45.0, 90.0, 91.0]


@pytest.fixture(scope="module")
def known():
    config = RegistrationConfig(stages=RIGID)
    geometry = circular_geometry(ANGLES, sad=404.0, sdd=538.0, det_shape=(160, 96), pixel_spacing=(0.8, 0.8))
    return view_information(build_scene(plate(), config), geometry, config)


def expected(known, *views: int) -> float:
    return float(known.expected(torch.tensor([list(views)]))[0])


def test_views_from_other_sides_and_more_of_them_are_expected_to_be_better(known) -> None:
    assert expected(known, 0, 4) < 0.7 * expected(known, 0, 1)
    assert expected(known, 0, 3, 4) < expected(known, 0, 4)
    assert expected(known, 0, 1, 2) > expected(known, 0, 1, 4)


def test_the_best_set_is_the_best_of_all_and_comes_first(known) -> None:
    sets = list(itertools.combinations(range(len(ANGLES)), 3))
    errors = known.expected(torch.tensor(sets))
    best = known.best(3, kept=4)
    assert best[0].views == sets[int(errors.argmin())]
    assert best[0].node_std_mm == pytest.approx(float(errors.min()))
    assert [one.node_std_mm for one in best] == sorted(one.node_std_mm for one in best)
    assert len({one.views for one in best}) == 4
    assert set(known.best(2, among=[0, 1, 2])[0].views) <= {0, 1, 2}
    with pytest.raises(ValueError, match="2 views, fewer than the 3"):
        known.best(3, among=[0, 1])


def test_where_not_all_sets_can_be_gone_through_an_exchange_finds_the_best(known, monkeypatch) -> None:
    monkeypatch.setattr("torchkcreg.registration.planning._MOST_SETS", 4)
    everything = known.expected(torch.tensor(list(itertools.combinations(range(len(ANGLES)), 2))))
    assert known.best(2)[0].node_std_mm == pytest.approx(float(everything.min()), rel=0.05)

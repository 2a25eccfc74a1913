import math

import pytest
import torch

from torchkcreg.reconstruction.redundancy import angular_sampling, full_scan_weights, parker_weights


@pytest.mark.parametrize("scan_deg", [200.0, 240.0, 300.0])
def test_a_line_seen_twice_in_a_short_scan_counts_once(scan_deg):
    scan = math.radians(scan_deg)
    b = torch.linspace(0, scan, 301, dtype=torch.float64)[:, None]
    g = torch.linspace(-0.15, 0.15, 31, dtype=torch.float64).expand(301, 31)
    weights = parker_weights(b[:, 0], g, scan)
    for turn in (-2 * math.pi, 0.0):
        again = b + math.pi - 2 * g + turn
        seen = (again >= 0) & (again <= scan)
        twin = torch.stack([parker_weights(again[:, i], -g[:1, i], scan)[:, 0] for i in range(31)], dim=1)
        assert torch.allclose((weights + twin)[seen], torch.ones(()).double(), atol=1e-9)


def test_a_line_seen_once_counts_once():
    weights = parker_weights(torch.tensor([1.5]), torch.linspace(-0.1, 0.1, 5), math.radians(200))
    assert torch.equal(weights, torch.ones(1, 5))


def test_lines_beyond_the_fan_that_the_scan_allows_keep_weights_between_zero_and_one():
    scan = math.radians(200)
    b = torch.linspace(0, scan, 200)
    weights = parker_weights(b, torch.linspace(-0.4, 0.4, 41), scan)
    assert weights.isfinite().all() and weights.min() >= 0 and weights.max() <= 1


def test_an_offset_detector_counts_its_overlap_once():
    columns = torch.linspace(-20, 80, 101, dtype=torch.float64)
    weights = full_scan_weights(columns, 400.0)
    assert weights[0] == pytest.approx(0.0, abs=1e-12) and weights[-1] == 1.0
    assert torch.allclose(weights[:41] + weights[:41].flip(0), torch.ones(41).double())


def test_a_centred_detector_counts_everything_half():
    assert (full_scan_weights(torch.linspace(-50, 51, 100), 400.0) == 0.5).all()


def test_steps_of_shuffled_irregular_views_cover_the_turn():
    angles = torch.tensor([0.0, 10, 30, 50, 90, 100, 140, 170, 200, 230, 260, 290, 320, 340]).deg2rad()
    order = torch.randperm(14, generator=torch.Generator().manual_seed(1))
    sampling = angular_sampling(angles[order])
    assert sampling.full
    assert float(sampling.steps.sum()) == pytest.approx(2 * math.pi)
    assert math.degrees(sampling.steps[order.argsort()][1]) == pytest.approx(15.0)


def test_a_short_scan_across_zero_begins_after_its_gap():
    angles = (torch.arange(250.0, 250.0 + 200.0, 2.0) % 360).deg2rad()
    sampling = angular_sampling(angles)
    assert not sampling.full
    assert math.degrees(sampling.scan_range) == pytest.approx(200.0, abs=1e-4)
    assert math.degrees(sampling.angles[0]) == pytest.approx(1.0, abs=1e-4)


def test_less_than_half_a_turn_is_refused():
    with pytest.raises(ValueError, match=r"cover 120.0 degrees"):
        angular_sampling(torch.arange(0.0, 120.0).deg2rad())
    with pytest.raises(ValueError, match="at least 3 views"):
        angular_sampling(torch.tensor([0.0, 1.0]))

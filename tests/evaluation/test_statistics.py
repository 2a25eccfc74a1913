import pickle

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from torchkcreg.evaluation import distance_statistics, full_width_at_half_maximum


@pytest.fixture
def noise():
    return torch.randn(3, 100_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_the_width_of_a_normal_distribution_is_2_355_sigma(noise):
    assert full_width_at_half_maximum(7 + 0.1 * noise[0]) == pytest.approx(2.3548 * 0.1, rel=0.03)


def test_the_width_of_a_rayleigh_distribution_is_where_its_density_halves(noise):
    distances = 0.1 * noise[:2].norm(dim=0)

    def above_half(r):
        return r * np.exp((1 - r**2) / 2) - 0.5  # the density has its maximum at 1

    width = brentq(above_half, 1, 5) - brentq(above_half, 0, 1)
    assert full_width_at_half_maximum(distances, lowest=0.0) == pytest.approx(0.1 * width, rel=0.03)


def test_the_width_of_a_half_normal_distribution_begins_at_zero(noise):
    assert full_width_at_half_maximum(noise[0].abs(), lowest=0.0) == pytest.approx(2.3548 / 2, rel=0.03)


def test_the_width_scales_and_outliers_do_not_change_it(noise):
    width = full_width_at_half_maximum(noise[0])
    assert full_width_at_half_maximum(1e-3 * noise[0]) == pytest.approx(1e-3 * width, rel=1e-6)
    assert full_width_at_half_maximum(torch.cat([noise[0], torch.full((100,), 5000.0)])) == pytest.approx(
        width, rel=0.02
    )


def test_the_width_of_a_uniform_distribution_is_its_range():
    values = torch.rand(100_000, generator=torch.Generator().manual_seed(0))
    assert full_width_at_half_maximum(values, lowest=0.0) == pytest.approx(1, rel=0.02)


def test_equal_values_have_no_width():
    assert full_width_at_half_maximum(torch.full((5,), 0.3)) == 0
    assert full_width_at_half_maximum(torch.tensor([0.3])) == 0


def test_statistics_of_a_few_distances_are_known():
    statistics = distance_statistics(torch.tensor([0.0, 3.0, 4.0, 5.0]), num_bins=5)
    assert (statistics.num_points, statistics.mean_mm, statistics.max_mm) == (4, 3.0, 5.0)
    assert statistics.rmse_mm == pytest.approx(12.5**0.5)
    assert statistics.counts == (1, 0, 0, 1, 2)
    assert statistics.edges_mm == pytest.approx((0, 1, 2, 3, 4, 5))
    assert pickle.loads(pickle.dumps(statistics)) == statistics
    assert statistics.to_dict()["mean_mm"] == 3.0


def test_what_are_no_distances_is_refused():
    for values in (torch.zeros(0), torch.zeros(2, 3)):
        with pytest.raises(ValueError, match=r"shape \(N,\) with N > 0"):
            distance_statistics(values)
    for value in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="finite and not negative"):
            distance_statistics(torch.tensor([1.0, value]))
    with pytest.raises(ValueError, match="must not be below 0"):
        full_width_at_half_maximum(torch.tensor([-1.0]), lowest=0.0)

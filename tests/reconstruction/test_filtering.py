import math

import pytest
import torch

from torchkcreg.reconstruction.fdk import WINDOWS, filter_rows, ramp_response


def test_the_response_is_the_ramp_away_from_zero_and_positive_at_zero():
    response = ramp_response(1024, 0.5, dtype=torch.float64)
    frequencies = torch.arange(513) / (1024 * 0.5)
    assert (response[1:] - frequencies[1:]).abs().max() < 1e-3
    assert 0 < response[0] < 1e-3


@pytest.mark.parametrize("window", WINDOWS)
def test_windows_only_damp_and_leave_low_frequencies_alone(window):
    plain, damped = ramp_response(256, 1.0), ramp_response(256, 1.0, window=window)
    assert (damped <= plain + 1e-7).all()
    assert damped[2] == pytest.approx(float(plain[2]), rel=0.01)


def test_beyond_the_cutoff_nothing_passes():
    response = ramp_response(256, 1.0, window="hann", cutoff=0.5)
    assert response[65:].abs().max() == 0
    assert response[30] > 0.02


def test_filtering_is_the_convolution_with_the_sampled_kernel():
    spacing, size = 0.7, 33
    rows = torch.randn(3, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offsets = torch.arange(size)[:, None] - torch.arange(size)
    odd = offsets % 2 == 1
    kernel = torch.where(odd, -1 / (math.pi * offsets.double().abs().clamp_min(1) * spacing) ** 2, 0.0)
    kernel += torch.eye(size) / (4 * spacing**2)
    expected = rows @ kernel * spacing
    assert torch.allclose(filter_rows(rows, spacing, extrapolate=False), expected, atol=1e-12)


def test_rows_that_end_in_air_do_not_feel_the_extrapolation():
    rows = torch.zeros(1, 64)
    rows[0, 20:40] = 1.0
    plain = filter_rows(rows, 1.0, extrapolate=False)
    assert torch.allclose(filter_rows(rows, 1.0), plain, atol=1e-6)


def test_a_truncated_row_gets_no_bright_rim():
    rows = torch.ones(1, 128)
    rim = filter_rows(rows, 1.0, extrapolate=False)[0, [0, -1]]
    assert (rim > 0.1).all()
    assert (filter_rows(rows, 1.0)[0, [0, -1]].abs() < 0.02).all()


def test_wrong_windows_and_cutoffs_are_named():
    with pytest.raises(ValueError, match="window must be one of"):
        ramp_response(16, 1.0, window="boxcar")
    with pytest.raises(ValueError, match="cutoff must be in"):
        ramp_response(16, 1.0, cutoff=0.0)

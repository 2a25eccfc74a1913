"""From counts to line integrals."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.physics import line_integrals_from_intensity


def test_counts_behind_a_known_attenuation_give_it_back():
    truth = torch.linspace(0, 4, 24, dtype=torch.float64).reshape(1, 4, 6)
    line_integrals, valid = line_integrals_from_intensity(2500 * torch.exp(-truth), 2500.0)
    torch.testing.assert_close(line_integrals, truth)
    assert valid.all()


def test_dead_saturated_and_broken_pixels_are_masked_and_finite():
    counts = torch.tensor([[[0.0, -3.0, math.nan, math.inf, -math.inf, 4095.0, 100.0]]])
    line_integrals, valid = line_integrals_from_intensity(counts, 3000.0, saturation=4095)
    assert valid.tolist() == [[[False, False, False, False, False, False, True]]]
    assert torch.isfinite(line_integrals).all()


def test_the_floor_bounds_the_line_integral():
    counts = torch.tensor([[[0, 1]]], dtype=torch.uint16)
    line_integrals, _ = line_integrals_from_intensity(counts, 1000.0)
    assert line_integrals.dtype == torch.float32
    assert line_integrals.flatten().tolist() == pytest.approx([math.log(2000), math.log(1000)])
    line_integrals, _ = line_integrals_from_intensity(counts, 1000.0, floor=2.0)
    assert line_integrals.flatten().tolist() == pytest.approx([math.log(500)] * 2)


def test_the_open_beam_may_differ_between_views_and_pixels():
    counts = torch.full((2, 3, 4), 100.0)
    per_view, _ = line_integrals_from_intensity(counts, torch.tensor([100.0, 200.0]))
    torch.testing.assert_close(per_view[1], torch.full((3, 4), math.log(2)))
    per_pixel, _ = line_integrals_from_intensity(counts, 100 * torch.arange(1, 13).reshape(3, 4))
    torch.testing.assert_close(per_pixel[0].flatten(), torch.arange(1, 13).log())


def test_wrong_open_beams_and_floors_are_errors():
    counts = torch.ones(2, 3, 4)
    for open_beam, message in (
        (0.0, "positive, got 0"),
        (torch.ones(3), "one a view"),
        (torch.ones(5, 5), "one a view"),
    ):
        with pytest.raises(ValueError, match=message):
            line_integrals_from_intensity(counts, open_beam)
    with pytest.raises(ValueError, match="floor"):
        line_integrals_from_intensity(counts, 1.0, floor=0.0)

"""Gradient difference: what it sees beyond gradient correlation, and what it shares with it."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.similarity import GradientCorrelation, GradientDifference


def images(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def test_an_offset_means_nothing_and_a_factor_costs_its_square():
    fixed = images(2, 20, 18)
    gd = GradientDifference(fixed)
    torch.testing.assert_close(gd(fixed + 3.0), torch.ones(2).double())
    torch.testing.assert_close(gd(0.8 * fixed), torch.full((2,), 1 - 0.5 * 0.2**2).double())


def test_near_a_match_of_equal_contrast_it_is_gradient_correlation():
    fixed = images(3, 24, 24)
    noise = 1e-3 * images(3, 24, 24)
    moving = fixed + noise
    scale = (GradientCorrelation(fixed)(moving) - GradientDifference(fixed)(moving)).abs()
    assert float(scale.max()) < 1e-6


def test_squared_residuals_sum_to_the_loss_with_mask_and_weights():
    fixed, moving, weights = images(2, 16, 16), images(4, 2, 16, 16).flip(0), images(2, 16, 16)
    mask = torch.ones(2, 16, 16, dtype=torch.bool)
    mask[:, 3:6, 7:9] = False
    gd = GradientDifference(fixed, mask, weights)
    broken = torch.where(mask, moving, torch.nan)
    torch.testing.assert_close(gd(broken), 1 - gd.residuals(broken).square().sum((-3, -2, -1)) / 4)


def test_a_flat_measured_view_says_nothing():
    fixed = images(2, 16, 16)
    fixed[1] = 0.7
    gd = GradientDifference(fixed)
    moving = images(2, 16, 16).flip(-1).requires_grad_(True)
    gd(moving).sum().backward()
    assert gd(moving)[1] == 0.0 and gd(fixed)[1] == 0.0 and gd(fixed)[0] == pytest.approx(1.0)
    assert bool((moving.grad[1] == 0).all()) and bool((gd.residuals(fixed)[1] == 0).all())


def test_a_view_masked_as_a_whole_agrees_with_nothing():
    fixed, mask = images(2, 16, 16), torch.ones(2, 16, 16)
    mask[1] = 0
    gd = GradientDifference(fixed, mask)
    assert gd(fixed).tolist() == [pytest.approx(1.0), 0.0]


def test_a_ramp_is_half_of_a_perfect_match():
    ramp = torch.arange(16.0).square().expand(1, 16, 16)  # flat along v
    assert GradientDifference(ramp)(ramp).tolist() == [pytest.approx(0.5)]


def test_gradients_agree_with_differences():
    gd = GradientDifference(images(1, 8, 8))
    moving = images(2, 1, 8, 8).flip(-1).requires_grad_(True)
    assert torch.autograd.gradcheck(gd, (moving,))


def test_weights_below_zero_are_refused():
    with pytest.raises(ValueError, match="negative"):
        GradientDifference(images(1, 8, 8), weights=-images(1, 8, 8))


@pytest.mark.parametrize("bad", [1e5, 1e6, float("inf"), float("nan")])
def test_what_a_masked_pixel_holds_does_not_matter(bad):
    generator = torch.Generator().manual_seed(0)
    fixed, moving = torch.rand(2, 1, 64, 64, generator=generator)
    mask = torch.ones(1, 64, 64, dtype=torch.bool)
    mask[0, 3, 3] = False
    spoiled = fixed.clone()
    spoiled[0, 3, 3] = bad
    expected, given = GradientDifference(fixed, mask), GradientDifference(spoiled, mask)
    assert torch.equal(given(moving), expected(moving))
    assert float(given(moving)) < 0.9


def test_images_of_another_shape_are_refused_larger_and_smaller():
    gd = GradientDifference(images(2, 12, 12))
    for shape in ((2, 12, 13), (2, 12, 11), (3, 12, 12), (1, 12, 12), (12, 12)):
        with pytest.raises(ValueError):
            gd(torch.zeros(shape))
    for shape in ((12, 12), (1, 2, 12, 12)):
        with pytest.raises(ValueError, match="fixed must have shape"):
            GradientDifference(torch.zeros(shape))


def test_weighted_means_are_taken_out_of_every_derivative():
    """An even ramp changes nothing away from the border, where the Sobel filter repeats the outermost pixels."""
    fixed, weights = images(2, 16, 16), images(2, 16, 16)
    column, row = torch.arange(16.0), torch.arange(16.0)[:, None]
    gd = GradientDifference(fixed, weights=weights)
    tilted = fixed + 0.3 * column + 0.2 * row
    inside = torch.ones(2, 16, 16, dtype=torch.bool)
    inside[:, 0], inside[:, -1], inside[..., 0], inside[..., -1] = False, False, False, False
    away = GradientDifference(fixed, inside, weights)
    torch.testing.assert_close(away(tilted), away(fixed), atol=1e-5, rtol=0)
    assert float(gd(tilted).max()) < 1.0

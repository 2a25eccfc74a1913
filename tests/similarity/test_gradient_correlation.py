"""Gradient correlation and its modules."""

import numpy as np
import pytest
import scipy.ndimage
import torch

from torchkcreg.similarity import GradientCorrelation, GradientCorrelationLoss, gradient_correlation
from torchkcreg.similarity.gradient_correlation import _PIXELS_PER_BLOCK


def images(*shape, seed=0, dtype=torch.float64):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def hole(views, rows, cols):
    mask = torch.ones(views, rows, cols)
    mask[:, 3:5, 2:6] = 0
    return mask


def test_an_image_matches_itself_with_one_and_its_negative_with_minus_one():
    x = images(3, 12, 10)
    assert torch.allclose(gradient_correlation(torch.stack([x, -x]), x)[0], torch.ones(3, dtype=x.dtype))
    assert torch.allclose(gradient_correlation(torch.stack([x, -x]), x)[1], -torch.ones(3, dtype=x.dtype))


@pytest.mark.parametrize("amplitude", [1e-3, 1.0, 20.0])
@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_amplitude_and_offset_do_not_matter_in_single_precision(amplitude, offset):
    x, y = images(2, 24, 20, dtype=torch.float32), images(2, 24, 20, seed=1, dtype=torch.float32)
    expected = gradient_correlation(y.double(), x.double())
    gc = gradient_correlation(amplitude * y + offset * amplitude, amplitude * x + 1)
    assert torch.allclose(gc.double(), expected, atol=2e-4 if amplitude < 1 else 1e-5)


@pytest.mark.parametrize("value", [0.0, 1e-3, 20.3])
def test_a_flat_view_gives_zero_with_zero_gradient_and_leaves_the_others_alone(value):
    x = images(2, 20, 16, dtype=torch.float32)
    y = images(2, 20, 16, seed=1, dtype=torch.float32)
    y[0] = value
    y.requires_grad_()
    gc = gradient_correlation(y, x)
    gc.sum().backward()
    assert gc[0] == 0 and gc[1] != 0
    assert (y.grad[0] == 0).all() and (y.grad[1] != 0).any() and torch.isfinite(y.grad).all()


def test_a_ramp_is_flat_in_the_derivative_across_it_only():
    x = images(1, 20, 20)
    ramp = torch.arange(20.0, dtype=torch.float64).square().expand(1, 20, 20)
    half = 0.5 * np.corrcoef(
        scipy.ndimage.sobel(ramp[0].numpy(), axis=1, mode="nearest").ravel(),
        scipy.ndimage.sobel(x[0].numpy(), axis=1, mode="nearest").ravel(),
    )
    assert float(gradient_correlation(ramp, x)) == pytest.approx(half[0, 1], abs=1e-12)


def test_it_agrees_with_plain_numpy_and_scipy_under_a_mask():
    x, y = images(1, 15, 13)[0].numpy(), images(1, 15, 13, seed=1)[0].numpy()
    mask = hole(1, 15, 13)[0].numpy() > 0
    mask[[0, -1]] = mask[:, [0, -1]] = False  # leaves borders, where the two filters' conventions could differ, out
    inside = scipy.ndimage.binary_erosion(mask, np.ones((3, 3)))
    pairs = [(scipy.ndimage.sobel(y, axis)[inside], scipy.ndimage.sobel(x, axis)[inside]) for axis in (0, 1)]
    expected = np.mean([np.corrcoef(*pair)[0, 1] for pair in pairs])
    gc = gradient_correlation(*(torch.from_numpy(a[None]) for a in (y, x)), mask=torch.from_numpy(mask[None]))
    assert float(gc) == pytest.approx(expected, abs=1e-13)


def test_masked_pixels_may_hold_anything_and_get_no_gradient():
    x, y, mask = images(2, 10, 9), images(4, 2, 10, 9, seed=1), hole(2, 10, 9)
    expected = gradient_correlation(y, x, mask=mask)
    for junk in (torch.nan, torch.inf, 1e30):
        spoilt_x, spoilt_y = (torch.where(mask != 0, z, junk) for z in (x, y))
        spoilt_y.requires_grad_()
        gc = gradient_correlation(spoilt_y, spoilt_x, mask=mask)
        gc.sum().backward()
        assert torch.equal(gc.detach(), expected)
        assert (spoilt_y.grad[:, mask == 0] == 0).all() and torch.isfinite(spoilt_y.grad).all()


def test_a_mask_changes_the_similarity():
    x, y = images(1, 10, 9), images(1, 10, 9, seed=1)
    assert gradient_correlation(y, x, mask=hole(1, 10, 9)) != gradient_correlation(y, x)


def test_weights_count_pixels_as_if_there_were_that_many():
    x, y = images(1, 12, 11)[0].numpy(), images(1, 12, 11, seed=1)[0].numpy()
    weights = np.random.default_rng(2).integers(0, 4, x.shape)
    weights[[0, -1]] = weights[:, [0, -1]] = 0  # the two filters' borders differ
    pairs = [[np.repeat(scipy.ndimage.sobel(z, axis).ravel(), weights.ravel()) for z in (y, x)] for axis in (0, 1)]
    expected = np.mean([np.corrcoef(*pair)[0, 1] for pair in pairs])
    similarity = GradientCorrelation(torch.from_numpy(x[None]), weights=torch.from_numpy(weights[None].astype(float)))
    assert float(similarity(torch.from_numpy(y[None]))) == pytest.approx(expected, abs=1e-12)


def test_squared_residuals_sum_to_the_loss_under_weights():
    x, y, weights = images(2, 10, 9), images(3, 2, 10, 9, seed=1), images(2, 10, 9, seed=2).abs()
    similarity = GradientCorrelation(x, torch.ones(2, 10, 9), weights)
    loss = similarity.residuals(y).square().sum((-3, -2, -1)) / 4
    torch.testing.assert_close(loss, 1 - similarity(y))


def test_a_view_masked_as_a_whole_gives_zero():
    x, mask = images(2, 8, 8), torch.ones(2, 8, 8)
    mask[0] = 0
    assert torch.allclose(gradient_correlation(x, x, mask=mask), torch.tensor([0.0, 1.0], dtype=x.dtype))
    assert (GradientCorrelation(x, mask).residuals(images(2, 8, 8, seed=1))[0] == 0).all()


def test_gradients_of_both_images_pass_gradcheck():
    x, y = images(2, 5, 6).requires_grad_(), images(2, 2, 5, 6, seed=1).requires_grad_()
    mask = torch.ones(2, 5, 6)
    mask[0, 0, 0] = 0
    assert torch.autograd.gradcheck(lambda y, x: gradient_correlation(y, x, mask=mask), (y, x), fast_mode=True)
    assert torch.autograd.gradcheck(GradientCorrelation(x, mask).residuals, (y,), fast_mode=True)


def test_the_module_gives_the_functions_numbers_for_many_candidates():
    x, mask = images(2, 64, 50, dtype=torch.float32), hole(2, 64, 50)
    candidates = images(3, 30, 2, 64, 50, seed=1, dtype=torch.float32)
    assert candidates.numel() > 2 * _PIXELS_PER_BLOCK, "the candidates must fill more than one block"
    gc = GradientCorrelation(x, mask)(candidates)
    assert gc.shape == (3, 30, 2)
    one_by_one = torch.stack([gradient_correlation(c, x, mask=mask) for c in candidates.reshape(-1, 2, 64, 50)])
    assert torch.allclose(gc.reshape(-1, 2), one_by_one, atol=1e-6)


def test_fixed_images_may_have_candidates_of_their_own():
    x, y = images(4, 2, 8, 8), images(4, 2, 8, 8, seed=1)
    assert torch.allclose(gradient_correlation(y, x)[3], gradient_correlation(y[3], x[3]))


@pytest.mark.parametrize("masked", [False, True])
def test_squared_residuals_sum_to_four_times_the_loss(masked):
    x, y = images(2, 10, 9), images(3, 2, 10, 9, seed=1)
    y[1, 0] = 7.0  # flat: NCC 0
    gc = GradientCorrelation(x, hole(2, 10, 9) if masked else None)
    assert torch.allclose(0.25 * gc.residuals(y).square().sum((-3, -2, -1)), 1 - gc(y))


def test_the_loss_is_one_minus_the_mean_over_views():
    x, y = images(3, 10, 9), images(2, 3, 10, 9, seed=1)
    assert torch.allclose(GradientCorrelationLoss(x)(y), 1 - gradient_correlation(y, x).mean(-1))


def test_the_fixed_side_is_state_that_moves_with_the_module():
    gc = GradientCorrelation(images(2, 8, 8), torch.ones(2, 8, 8))
    assert set(gc.state_dict()) == {"unit_gradients", "mask", "eroded_mask"}
    assert not list(gc.parameters())
    assert gc.float().unit_gradients.dtype == torch.float32


def test_wrong_images_are_refused_with_their_shapes():
    x = images(2, 8, 8)
    with pytest.raises(ValueError, match="agree in"):
        gradient_correlation(images(3, 8, 8), x)
    with pytest.raises(ValueError, match="mask and weights must have shape"):
        gradient_correlation(x, x, mask=torch.ones(8, 8))
    with pytest.raises(ValueError, match="fixed must have shape"):
        GradientCorrelation(x[0])
    x[0, 1, 1] = torch.nan
    with pytest.raises(ValueError, match="fixed must be finite"):
        GradientCorrelation(x)

"""Normalised cross-correlation."""

import numpy as np
import pytest
import torch

from torchkcreg.similarity import normalized_cross_correlation


def test_it_is_pearsons_correlation_of_the_pixels_that_count():
    rng = np.random.default_rng(1)
    a, b, mask = rng.random((6, 7)), rng.random((6, 7)), rng.random((6, 7)) > 0.3
    expected = np.corrcoef(a[mask], b[mask])[0, 1]
    ncc = normalized_cross_correlation(torch.from_numpy(a), torch.from_numpy(b), mask=torch.from_numpy(mask))
    assert float(ncc) == pytest.approx(expected, abs=1e-13)


def test_leading_axes_broadcast():
    a, b = torch.rand(3, 1, 5, 5), torch.rand(2, 5, 5)
    ncc = normalized_cross_correlation(a, b)
    assert ncc.shape == (3, 2)
    assert torch.allclose(ncc[1, 1], normalized_cross_correlation(a[1, 0], b[1]))


@pytest.mark.parametrize("value", [0.0, 1e-3, 20.3, 1e6])
def test_a_flat_image_gives_zero_and_zero_gradients(value):
    a = torch.full((40, 30), value, requires_grad=True)
    b = torch.rand(40, 30, requires_grad=True)
    ncc = normalized_cross_correlation(a, b)
    ncc.backward()
    assert ncc == 0
    assert (a.grad == 0).all() and (b.grad == 0).all()


def test_a_mask_without_pixels_gives_zero():
    assert normalized_cross_correlation(torch.rand(4, 4), torch.rand(4, 4), mask=torch.zeros(4, 4)) == 0


def test_masked_pixels_may_hold_anything():
    a, b = torch.rand(6, 6), torch.rand(6, 6)
    mask = torch.rand(6, 6) > 0.3
    expected = normalized_cross_correlation(a, b, mask=mask)
    a[~mask], b[~mask] = torch.nan, torch.inf
    assert torch.equal(normalized_cross_correlation(a, b, mask=mask), expected)


def test_gradients_pass_gradcheck():
    a, b = (torch.rand(2, 4, 5, dtype=torch.float64, requires_grad=True) for _ in range(2))
    mask = torch.rand(4, 5) > 0.2
    assert torch.autograd.gradcheck(lambda a, b: normalized_cross_correlation(a, b, mask=mask), (a, b))


def test_images_of_different_size_are_refused():
    with pytest.raises(ValueError, match="b must have"):
        normalized_cross_correlation(torch.rand(4, 4), torch.rand(4, 5))

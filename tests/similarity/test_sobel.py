"""Sobel derivatives and eroded masks."""

import numpy as np
import pytest
import scipy.ndimage
import torch

from torchkcreg.similarity import erode_mask, sobel_gradient
from torchkcreg.similarity.sobel import _adjoint


def test_a_ramp_has_its_slope_along_u_then_along_v():
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(7.0), indexing="ij")
    du, dv = sobel_gradient(3 * u - 2 * v).unbind(-3)
    assert torch.allclose(du[:, 1:-1], torch.tensor(3.0))
    assert torch.allclose(dv[1:-1], torch.tensor(-2.0))


def test_derivatives_agree_with_scipy_up_to_its_factor_of_eight():
    image = np.random.default_rng(0).random((11, 9))
    du, dv = sobel_gradient(torch.from_numpy(image)).numpy()
    np.testing.assert_allclose(du, scipy.ndimage.sobel(image, axis=1, mode="nearest") / 8, atol=1e-14)
    np.testing.assert_allclose(dv, scipy.ndimage.sobel(image, axis=0, mode="nearest") / 8, atol=1e-14)


@pytest.mark.parametrize("leading", [(), (2,), (3, 2), (2, 1, 3)])
def test_any_leading_axes_give_the_same_derivatives(leading):
    images = torch.rand(*leading, 5, 4)
    assert sobel_gradient(images).shape == (*leading, 2, 5, 4)
    one_by_one = torch.stack([sobel_gradient(image) for image in images.reshape(-1, 5, 4)])
    assert torch.equal(sobel_gradient(images), one_by_one.reshape(*leading, 2, 5, 4))


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 2), (6, 5)])
def test_the_adjoint_is_the_adjoint_of_the_filter_borders_included(size):
    image = torch.rand(2, 1, *size, dtype=torch.float64)
    gradients = torch.rand(2, 2, *size, dtype=torch.float64)
    assert torch.allclose((sobel_gradient(image[:, 0]) * gradients).sum(), (image * _adjoint(gradients)).sum())


def test_first_and_second_derivatives_pass_gradcheck_in_both_modes():
    image = torch.rand(1, 3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sobel_gradient, image, check_forward_ad=True, check_batched_grad=True)
    assert torch.autograd.gradgradcheck(lambda x: sobel_gradient(x).square(), image)


def test_erosion_takes_the_neighbours_of_masked_pixels_but_not_the_border():
    mask = torch.ones(2, 6, 7)
    mask[0, 2, 3] = 0
    eroded = erode_mask(mask)
    expected = torch.ones(2, 6, 7, dtype=torch.bool)
    expected[0, 1:4, 2:5] = False
    assert torch.equal(eroded, expected)


@pytest.mark.parametrize("bad", [torch.rand(4), torch.rand(0, 3), torch.ones(3, 3, dtype=torch.long)])
def test_images_that_are_none_are_refused(bad):
    with pytest.raises(ValueError, match="images must"):
        sobel_gradient(bad)

"""The Gaussian blur: moments, borders, adjoint, gradient."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.physics import gaussian_blur, gaussian_kernel


def test_an_impulse_spreads_with_the_variance_asked_for():
    image = torch.zeros(41, 41, dtype=torch.float64)
    image[20, 20] = 1
    blurred = gaussian_blur(image, 1.7)
    offsets = torch.arange(41, dtype=torch.float64) - 20
    assert float(blurred.sum()) == pytest.approx(1)
    for axis in (0, 1):
        assert float((blurred.sum(1 - axis) * offsets**2).sum()) == pytest.approx(1.7**2, rel=1e-3)


def test_a_flat_image_stays_flat_up_to_its_border():
    image = torch.full((2, 5, 7), 3.0)
    torch.testing.assert_close(gaussian_blur(image, 1.2), image)


def test_no_sigma_is_the_identity():
    image = torch.rand(4, 6)
    torch.testing.assert_close(gaussian_blur(image, 0.0), image)


def test_kernels_of_several_sigmas_share_a_length_and_sum_to_one():
    kernels = gaussian_kernel(torch.tensor([0.0, 0.4, 2.0]))
    assert kernels.shape == (3, 19)
    torch.testing.assert_close(kernels.sum(-1), torch.ones(3))
    assert float(kernels[0, 9]) == 1


def test_the_blur_of_images_and_the_kernel_can_be_differentiated():
    images = torch.rand(2, 4, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: gaussian_blur(x, 0.6), (images,))
    sigmas = torch.tensor([0.5, 0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(gaussian_kernel, (sigmas,))

"""The Gaussian blur: moments, borders, adjoint, gradient."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.kernels import kernel
from torchkcreg.physics import gaussian_blur, gaussian_kernel
from torchkcreg.physics.blur import BLUR

blur = kernel(BLUR, torch.zeros(0, device="cpu"), "cpp")


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


@pytest.mark.parametrize("transposed", (False, True))
@pytest.mark.parametrize("taps", (3, 11, 41))
@pytest.mark.parametrize("shape", ((2, 5, 7), (3, 40, 133), (1, 1, 9), (2, 9, 1)))
def test_the_kernel_is_the_reference_and_its_transpose_for_any_kernel_and_border(shape, taps, transposed):
    generator = torch.Generator().manual_seed(taps)
    images, kernel = (torch.rand(size, generator=generator, dtype=torch.float64) for size in (shape, (taps,)))
    found = blur(images, kernel, transposed)
    torch.testing.assert_close(found, BLUR.reference(images, kernel, transposed), rtol=1e-12, atol=0)
    single = blur(images.float(), kernel.float(), transposed)
    torch.testing.assert_close(single.double(), found, rtol=1e-5, atol=0)


def test_the_transposed_blur_is_the_adjoint():
    images, other = torch.rand(2, 3, 20, 30, dtype=torch.float64)
    kernel = torch.rand(9, dtype=torch.float64)  # not symmetric
    one_way = float((blur(images, kernel, False) * other).sum())
    assert one_way == pytest.approx(float((images * blur(other, kernel, True)).sum()), rel=1e-12)


def test_the_kernel_refuses_what_does_not_fit():
    with pytest.raises(RuntimeError, match="odd number of taps"):
        blur(torch.rand(1, 4, 4), torch.rand(4), False)
    with pytest.raises(RuntimeError, match="of one dtype"):
        blur(torch.rand(1, 4, 4), torch.rand(3).double(), False)


@pytest.mark.parametrize("backend", ("cpp", "torch"))
def test_both_backends_blur_alike_in_every_mode_of_differentiation(backend):
    images = torch.rand(2, 6, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: gaussian_blur(x, 0.8, backend=backend), (images,), check_forward_ad=True, check_batched_grad=True
    )

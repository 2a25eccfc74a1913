import pytest
import torch

from torchkcreg.physics import gaussian_blur
from torchkcreg.reconstruction import Veil, fit_veil, floored_line_integrals, refined_scatter, veil_image

PITCH = (2.0, 2.0)


def shadows(views=6, rows=48, cols=80):
    """Transmissions of a slab that moves over the detector, in front of air."""
    u = torch.arange(cols)
    images = [1 - 0.85 * ((u - 40 - 3 * view).abs() < 18).float().expand(rows, cols) for view in range(views)]
    return torch.stack(images)


def veiled(primary, veil):
    return primary + veil.fraction * gaussian_blur(primary, veil.sigma_mm / PITCH[0])


@pytest.mark.parametrize("veil", [Veil(0.3, 25.0), Veil(0.1, 50.0)])
def test_a_known_veil_is_taken_away(veil):
    primary = shadows()
    measured = veiled(primary, veil)
    assert (measured - veil_image(measured, veil, PITCH) - primary).abs().max() < 0.01


def test_beyond_a_detector_that_cuts_the_object_there_is_air_soon():
    whole = torch.cat([torch.ones(1, 40, 20), torch.full((1, 40, 50), 0.15), torch.ones(1, 40, 90)], -1)
    veil = Veil(0.3, 30.0)
    measured = veiled(whole, veil)[..., 24:]  # 8 mm of the object are outside
    left = measured - veil_image(measured, veil, PITCH) - whole[..., 24:]
    assert left[..., 10:].abs().max() < 0.02


@pytest.mark.parametrize("veil", [Veil(0.3, 30.0), Veil(0.12, 50.0)])
def test_the_air_around_an_object_tells_the_veil(veil):
    primary = shadows()
    noise = 0.003 * torch.randn(primary.shape, generator=torch.Generator().manual_seed(0))
    fitted = fit_veil(veiled(primary, veil) + noise, PITCH)
    left = veiled(primary, veil) - veil_image(veiled(primary, veil), fitted, PITCH) - primary
    assert fitted.fraction == pytest.approx(veil.fraction, rel=0.1)
    assert left.abs().mean() < 0.05 * veil.fraction


def test_an_image_without_a_veil_gets_next_to_none():
    assert fit_veil(shadows(), PITCH).fraction < 0.01


def test_a_detector_without_air_is_refused():
    with pytest.raises(ValueError, match="pixels show air, too few"):
        fit_veil(torch.full((4, 40, 40), 0.2), PITCH)


def test_known_metal_shows_what_is_left_of_the_scatter():
    primary = shadows()
    metal = torch.where((torch.arange(80) - 40).abs() < 8, 0.001, 1.0).expand_as(primary)
    predicted = primary * metal
    measured = predicted + 0.11
    refined = refined_scatter(measured, torch.full_like(primary, 0.1), predicted, metal, PITCH)
    assert refined[:, :, 40].mean() == pytest.approx(0.11, abs=0.001)
    assert refined[:, :, 0].mean() == pytest.approx(0.1, abs=1e-4)


def test_the_logarithm_has_a_floor():
    values = floored_line_integrals(torch.tensor([1.0, 0.0, -3.0]), floor=0.01)
    assert values[0] == 0 and values[1] == values[2] == pytest.approx(4.6052, rel=1e-4)
    with pytest.raises(ValueError, match="floor must be positive"):
        floored_line_integrals(torch.ones(1), floor=0.0)


def test_a_veil_that_is_none_is_refused():
    with pytest.raises(ValueError, match="fraction"):
        Veil(-0.1)
    with pytest.raises(ValueError, match="sigma_mm"):
        Veil(0.1, 0.0)

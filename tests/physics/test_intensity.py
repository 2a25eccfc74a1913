"""Intensity models: monochromatic truth, hardening, blur and scatter, gradients, candidates."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.physics import (
    IdentityIntensity,
    PolyenergeticTransmission,
    Spectrum,
    gaussian_blur,
    material,
    tungsten_spectrum,
)

MONO = Spectrum((60.0,), (1.0,))
STEEL, BONE = material("steel"), material("cortical_bone")


def random_lengths(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 6 * torch.rand(*shape, dtype=torch.float64, generator=generator)


def test_the_identity_sums_the_materials():
    lengths = random_lengths(2, 3, 1, 4, 5)
    torch.testing.assert_close(IdentityIntensity()(lengths), lengths.sum(1))
    torch.testing.assert_close(IdentityIntensity()(lengths[:, :1]), lengths[:, 0])


def test_one_energy_gives_attenuation_times_length():
    lengths = random_lengths(2, 1, 3, 4)
    model = PolyenergeticTransmission([STEEL, BONE], MONO)
    expected = STEEL.attenuation(60.0) * lengths[0] + BONE.attenuation(60.0) * lengths[1]
    torch.testing.assert_close(model(lengths), expected)


def test_several_energies_scatter_and_blur_follow_the_formula():
    spectrum = tungsten_spectrum(90)
    lengths = random_lengths(2, 2, 9, 8)
    model = PolyenergeticTransmission(
        [STEEL, BONE], spectrum, scatter=0.08, blur_sigma_px=0.7, hardness=1.5, num_bins=None
    )
    hard = spectrum.filtered(material("aluminium"), 1.5)
    exponent = sum(m.attenuation(hard.energies_kev)[:, None, None, None] * x for m, x in zip((STEEL, BONE), lengths))
    signal = (torch.tensor(hard.weights, dtype=torch.float64)[:, None, None, None] * (-exponent).exp()).sum(0)
    expected = -torch.log(gaussian_blur(signal, 0.7) + 0.08) + math.log(1.08)
    torch.testing.assert_close(model(lengths), expected)


def test_the_default_reduction_changes_the_line_integrals_by_less_than_a_thousandth():
    lengths = torch.linspace(0, 25, 200, dtype=torch.float64).reshape(1, 1, 10, 20)
    whole = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), num_bins=None)(lengths)
    reduced = PolyenergeticTransmission([STEEL], tungsten_spectrum(90))
    assert len(reduced.beam.weights) <= 10
    torch.testing.assert_close(reduced(lengths), whole, rtol=0, atol=1e-3)


def test_an_empty_beam_reads_zero_whatever_the_parameters():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), scatter=0.2, blur_sigma_px=1.0, hardness=2.0)
    torch.testing.assert_close(model(torch.zeros(1, 2, 5, 5)), torch.zeros(2, 5, 5), rtol=0, atol=1e-6)


def test_steel_hardens_the_beam():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90))
    first, second = model(torch.tensor([5.0, 10.0]).reshape(1, 1, 1, 2)).flatten().tolist()
    assert second < 1.9 * first


def test_scatter_bounds_the_line_integral():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), scatter=0.1)
    assert model(torch.full((1, 1, 1, 1), 1e4)).item() == pytest.approx(math.log(1.1 / 0.1), rel=1e-5)


def test_each_candidate_may_have_its_own_parameters():
    model = PolyenergeticTransmission([STEEL, BONE], tungsten_spectrum(90), scatter=0.5)
    lengths = random_lengths(3, 2, 1, 6, 7)
    scatter, sigma, hardness = torch.tensor([[0.0, 0.1, 0.2], [0.3, 0.0, 1.0], [0.0, -1.0, 2.0]]).double()
    together = model(lengths, scatter=scatter, blur_sigma_px=sigma, hardness=hardness)
    for k in range(3):
        alone = model(lengths[k], scatter=scatter[k], blur_sigma_px=sigma[k], hardness=hardness[k])
        torch.testing.assert_close(together[k], alone)


def test_leading_axes_are_free_and_the_dtype_is_kept():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), blur_sigma_px=0.5)
    lengths = random_lengths(2, 3, 1, 2, 4, 4).float()
    result = model(lengths)
    assert result.shape == (2, 3, 2, 4, 4)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result[1, 2], model(lengths[1, 2]))
    torch.testing.assert_close(result.double(), model(lengths.double()), rtol=1e-5, atol=1e-5)


def test_every_input_and_parameter_can_be_differentiated():
    model = PolyenergeticTransmission([STEEL, BONE], tungsten_spectrum(90), num_bins=4)
    lengths = random_lengths(2, 2, 2, 4, 5).requires_grad_()
    settings = [
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in ([0.05, 0.1], [0.6, 0.9], [0.5, -0.5])
    ]
    assert torch.autograd.gradcheck(
        lambda x, s, b, h: model(x, scatter=s, blur_sigma_px=b, hardness=h), (lengths, *settings)
    )


def test_scatter_follows_its_shape_over_the_detector():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), scatter=0.2)
    lengths, shapes = random_lengths(1, 1, 2, 6, 6), 0.5 + torch.rand(2, 2, 6, 6, dtype=torch.float64)
    primary = torch.exp(-model(lengths, scatter=torch.zeros(1)))
    expected = -torch.log(primary + 0.2 * shapes[0] + 0.1 * shapes[1]) + math.log(1.2)
    removed = torch.tensor([0.1], dtype=torch.float64)
    torch.testing.assert_close(model(lengths, scatter_removed=removed, scatter_shapes=shapes), expected)


def test_gradients_know_the_shapes_of_the_scatter():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), num_bins=3)
    lengths, shapes = random_lengths(1, 1, 1, 4, 4).requires_grad_(), torch.rand(2, 1, 2, 2, dtype=torch.float64)
    scatter, removed = (torch.tensor([s], dtype=torch.float64, requires_grad=True) for s in (0.1, 0.2))
    assert torch.autograd.gradcheck(
        lambda x, s, r: model(x, scatter=s, scatter_removed=r, pooling=2, scatter_shapes=shapes),
        (lengths, scatter, removed),
    )


def test_the_modules_own_parameters_receive_gradients():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90), scatter=0.1, blur_sigma_px=0.6, hardness=0.2)
    lengths = random_lengths(4, 1, 1, 6, 6)
    model(lengths).square().sum().backward()
    for parameter in model.parameters():
        value = float(parameter.detach())
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                parameter.fill_(value + step)
                values.append(float(model(lengths).square().sum()))
        assert float(parameter.grad) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-6)
        with torch.no_grad():
            parameter.fill_(value)


def test_blocks_of_pixels_join_without_a_seam():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90))
    lengths = random_lengths(1, 1, 300, 400)  # more pixels than a block holds
    torch.testing.assert_close(model(lengths)[:, 150:], model(lengths[:, :, 150:]))


def test_complete_starvation_stays_finite():
    model = PolyenergeticTransmission([STEEL], tungsten_spectrum(90))
    lengths = torch.full((1, 1, 2, 2), 1e5, requires_grad=True)
    result = model(lengths)
    result.sum().backward()
    assert torch.isfinite(result).all()
    assert torch.isfinite(lengths.grad).all()


def test_wrong_shapes_and_values_are_errors():
    model = PolyenergeticTransmission([STEEL, BONE], MONO)
    with pytest.raises(ValueError, match=r"\(\.\.\., 2, V, rows, cols\), got \(1, 1, 4, 4\)"):
        model(torch.zeros(1, 1, 4, 4))
    with pytest.raises(ValueError, match="scatter must fit the candidates"):
        model(torch.zeros(3, 2, 1, 4, 4), scatter=torch.zeros(2))
    with pytest.raises(ValueError, match="materials"):
        PolyenergeticTransmission([], MONO)
    with pytest.raises(ValueError, match="blur_sigma_px"):
        PolyenergeticTransmission([STEEL], MONO, blur_sigma_px=-1)
    with pytest.raises(ValueError, match="path_lengths"):
        IdentityIntensity()(torch.zeros(4, 4))

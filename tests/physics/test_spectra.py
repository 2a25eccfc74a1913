"""Spectra: normalisation, filters, the reduction to few energies, tungsten tubes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from torchkcreg.physics import Spectrum, material, tungsten_spectrum


def transmission(spectrum: Spectrum, lengths: dict[str, np.ndarray]) -> np.ndarray:
    """Transmitted share behind materials' lengths in mm."""
    exponent = sum(
        np.multiply.outer(length, material(m).attenuation(spectrum.energies_kev).numpy())
        for m, length in lengths.items()
    )
    return np.exp(-exponent) @ np.array(spectrum.weights)


def test_weights_are_normalised():
    spectrum = Spectrum((20.0, 40.0), (3.0, 1.0))
    assert spectrum.weights == (0.75, 0.25)
    assert spectrum.mean_energy == 25.0


@pytest.mark.parametrize(
    ("energies", "weights", "message"),
    [
        ((1.0, 2.0), (1.0,), "pair"),
        ((), (), "pair"),
        ((2.0, 2.0), (1.0, 1.0), "rise"),
        ((1.0, 2.0), (1.0, -0.1), "negative"),
        ((1.0, 2.0), (0.0, 0.0), "zero"),
        ((1.0, 2.0), (1.0, float("nan")), "finite"),
    ],
)
def test_a_spectrum_that_makes_no_sense_is_refused(energies, weights, message):
    with pytest.raises(ValueError, match=message):
        Spectrum(energies, weights)


def test_a_filter_hardens_and_its_removal_restores():
    spectrum = tungsten_spectrum(90)
    aluminium = material("aluminium")
    harder = spectrum.filtered(aluminium, 3.0)
    assert harder.mean_energy > spectrum.mean_energy + 1
    np.testing.assert_allclose(harder.filtered(aluminium, -3.0).weights, spectrum.weights, rtol=1e-9)


@pytest.mark.parametrize("kvp", [70, 90, 120])
@pytest.mark.parametrize(
    "names", [("steel",), ("titanium", "cortical_bone"), ("steel", "cortical_bone", "soft_tissue")]
)
def test_a_few_energies_transmit_as_the_whole_spectrum(kvp, names):
    spectrum = tungsten_spectrum(kvp)
    reduced = spectrum.reduced([material(name) for name in names])
    assert len(reduced.weights) <= 12
    for name, longest in (("steel", 25.0), ("titanium", 25.0), ("cortical_bone", 60.0), ("soft_tissue", 200.0)):
        if name in names:
            lengths = {name: np.linspace(0, longest, 101)}
            np.testing.assert_allclose(
                transmission(reduced, lengths), transmission(spectrum, lengths), rtol=1e-3, atol=1e-9
            )
    if len(names) > 1:
        lengths = {names[0]: np.linspace(0, 15, 31), names[1]: np.linspace(30, 0, 31)}
        np.testing.assert_allclose(
            transmission(reduced, lengths), transmission(spectrum, lengths), rtol=1e-3, atol=1e-9
        )


def test_a_reduced_spectrum_can_be_hardened_afterwards():
    spectrum, aluminium = tungsten_spectrum(90), material("aluminium")
    reduced = spectrum.reduced([material("steel")])
    lengths = {"steel": np.linspace(0, 20, 41)}
    for thickness in (-1.0, 5.0):
        expected = transmission(spectrum.filtered(aluminium, thickness), lengths)
        np.testing.assert_allclose(transmission(reduced.filtered(aluminium, thickness), lengths), expected, rtol=1e-3)


def test_the_number_of_bins_is_a_limit():
    spectrum = tungsten_spectrum(90)
    assert len(spectrum.reduced([material("steel")], 4).weights) <= 4
    assert len(spectrum.reduced([material("steel")], 1).weights) == 1
    with pytest.raises(ValueError, match="num_bins"):
        spectrum.reduced([material("steel")], 0)


def test_a_single_energy_stays_as_it_is():
    mono = Spectrum((60.0,), (1.0,))
    assert mono.reduced([material("steel")]) == mono


def test_more_voltage_gives_harder_beams():
    means = [tungsten_spectrum(kvp).mean_energy for kvp in (70, 80, 90, 100, 110, 120)]
    assert all(b > a + 1 for a, b in pairwise(means))
    assert max(tungsten_spectrum(90).energies_kev) < 90


def test_the_tube_agrees_with_spekpy():
    spekpy = pytest.importorskip("spekpy")
    tube = spekpy.Spek(kvp=90, th=12, dk=1.0)
    tube.filter("Al", 2.5).filter("Cu", 0.2)
    energies, fluence = tube.get_spectrum()
    inside = energies > 15
    energies, fluence = energies[inside], fluence[inside]
    detected = fluence * energies * -np.expm1(-material("csi").attenuation(energies).numpy() * 0.6)
    # SpekPy filters with NIST's coefficients, this library with Elam's
    expected = Spectrum(tuple(energies), tuple(detected))
    assert tungsten_spectrum(90).mean_energy == pytest.approx(expected.mean_energy, abs=0.15)
    lengths = {"steel": np.linspace(0, 10, 21)}
    np.testing.assert_allclose(transmission(tungsten_spectrum(90), lengths), transmission(expected, lengths), rtol=0.02)

"""Materials: tables, interpolation, absorption edges, mixtures."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.physics import Material, calcium_in_water, material, material_names, mixture

POWER_LAW = Material("power", 2.0, (10.0, 20.0, 40.0, 40.0, 80.0), (8.0, 1.0, 0.125, 1.0, 0.125))


def test_a_power_law_is_interpolated_exactly():
    energies = torch.tensor([10.0, 14.0, 33.0], dtype=torch.float64)
    expected = 0.2 * 8.0 * (energies / 10) ** -3
    torch.testing.assert_close(POWER_LAW.attenuation(energies), expected)


def test_an_edge_is_not_smeared_and_belongs_to_the_side_above():
    below, at, above = POWER_LAW.attenuation([40.0 - 1e-9, 40.0, 40.0 + 1e-9]).tolist()
    assert below == pytest.approx(0.2 * 0.125, rel=1e-6)
    assert at == pytest.approx(0.2, rel=1e-9)
    assert above == pytest.approx(0.2, rel=1e-6)


def test_both_ends_of_the_table_can_be_asked_for():
    assert POWER_LAW.attenuation([10.0, 80.0]).tolist() == pytest.approx([1.6, 0.025])


@pytest.mark.parametrize("energy", [9.9, 80.1, math.nan])
def test_an_energy_outside_the_table_is_an_error_that_names_the_range(energy):
    with pytest.raises(ValueError, match="10 to 80 keV"):
        POWER_LAW.attenuation(energy)


def test_published_values_of_water_iron_and_bone_are_met():
    # NIST XCOM / Hubbell and Seltzer, cm^2/g at 60 keV; another compilation than the packaged one, hence 2 %
    assert float(material("water").attenuation(60.0)) * 10 == pytest.approx(0.2059, rel=0.01)
    assert float(material("iron").attenuation(60.0)) * 10 / 7.874 == pytest.approx(1.205, rel=0.02)
    assert float(material("cortical_bone").attenuation(60.0)) * 10 / 1.92 == pytest.approx(0.3148, rel=0.02)


def test_iodine_and_tungsten_jump_at_their_k_edges():
    for name, edge, ratio in (("iodine", 33.169, 5.4), ("tungsten", 69.525, 4.4)):
        below, above = material(name).attenuation([edge - 0.05, edge + 0.05]).tolist()
        assert above / below == pytest.approx(ratio, rel=0.1)


def test_aliases_and_densities_are_understood():
    assert material("316L") == material("steel")
    assert material("Ti-6Al-4V").density_g_cm3 == 4.43
    light = material("cortical_bone", density=0.96)
    assert float(light.attenuation(50.0)) == pytest.approx(0.5 * float(material("cortical_bone").attenuation(50.0)))


def test_an_unknown_material_is_an_error_that_lists_the_known():
    with pytest.raises(ValueError, match=r"steel.*got 'unobtainium'"):
        material("unobtainium")


def test_a_mixture_weighs_by_mass():
    energies = [20.0, 50.0, 100.0]
    mixed = mixture("half", {"water": 2.0, "calcium": 2.0}, density=1.3)
    water = material("water").attenuation(energies) / 1.0
    calcium = material("calcium").attenuation(energies) / 1.55
    torch.testing.assert_close(mixed.attenuation(energies), 1.3 * (water + calcium) / 2)


def test_calcium_adds_its_own_attenuation_to_the_waters():
    energies = [30.0, 60.0]
    added = calcium_in_water(200).attenuation(energies) - material("water").attenuation(energies)
    torch.testing.assert_close(added, 0.2 / 1.55 * material("calcium").attenuation(energies))
    assert calcium_in_water(0) == material("water")


@pytest.mark.parametrize(
    ("density", "energies", "values"),
    [
        (0.0, (1.0, 2.0), (1.0, 1.0)),
        (1.0, (2.0, 1.0), (1.0, 1.0)),
        (1.0, (1.0, 2.0), (1.0, 0.0)),
        (1.0, (1.0,), (1.0,)),
    ],
)
def test_a_table_that_makes_no_sense_is_refused(density, energies, values):
    with pytest.raises(ValueError, match="nonsense"):
        Material("nonsense", density, energies, values)


def test_negative_amounts_are_refused():
    with pytest.raises(ValueError, match="concentration_mg_ml"):
        calcium_in_water(-1)
    with pytest.raises(ValueError, match="parts"):
        mixture("nothing", {}, density=1.0)


@pytest.mark.parametrize("name", material_names())
def test_every_packaged_material_attenuates_as_xraydb_says(name):
    xraydb = pytest.importorskip("xraydb")
    from torchkcreg.physics.materials import _compositions

    density, fractions = _compositions()[name]
    energies = torch.linspace(10.05, 149.95, 1000, dtype=torch.float64)
    edges = [edge.energy / 1000 for symbol in fractions for edge in xraydb.xray_edges(symbol).values()]
    for edge in edges:  # its own tables of edges and of attenuation differ by some eV
        energies = energies[(energies - edge).abs() > 0.03]
    values = sum(f * xraydb.mu_elam(symbol, 1000 * energies.numpy()) for symbol, f in fractions.items())
    expected = torch.from_numpy(values) * density / 10 / sum(fractions.values())
    torch.testing.assert_close(material(name).attenuation(energies), expected, rtol=5e-4, atol=0)

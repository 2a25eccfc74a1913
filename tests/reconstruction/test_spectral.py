import pytest
import torch

from torchkcreg.physics import calcium_in_water, material, tungsten_spectrum
from torchkcreg.reconstruction import BeamModel, background_line_integrals, behind_metal, mineral_part

SPECTRUM = tungsten_spectrum(90)


def transmission(lengths):
    """Exact line integral behind materials: name or material and mm."""
    weights = torch.tensor(SPECTRUM.weights, dtype=torch.float64)
    exponent = sum(m.attenuation(SPECTRUM.energies_kev) * mm for m, mm in lengths)
    return float(-torch.log((weights * torch.exp(-exponent)).sum()))


@pytest.mark.parametrize("metal_mm", [0.0, 1.0, 6.0])
@pytest.mark.parametrize("water_mm", [0.0, 30.0, 120.0])
def test_water_behind_titanium_comes_out_at_the_reference_energy(metal_mm, water_mm):
    titanium, water = material("titanium"), material("water")
    beam = BeamModel.polyenergetic([titanium], SPECTRUM)
    measured = transmission([(titanium, metal_mm), (water, water_mm)])
    shares = behind_metal(torch.full((1, 1, 2, 2), metal_mm), beam)
    found, slope = background_line_integrals(torch.full((1, 2, 2), measured), shares, beam)
    assert found[0, 0, 0] == pytest.approx(beam.water * water_mm, rel=2e-3, abs=2e-3)
    assert 0.7 < slope[0, 0, 0] < 1.3


def test_the_slope_is_the_derivative_of_what_is_measured():
    beam = BeamModel.polyenergetic([material("steel")], SPECTRUM)
    shares = behind_metal(torch.full((1, 1, 1, 1), 2.0), beam).double()
    values = torch.tensor([5.0, 5.001], dtype=torch.float64)
    found, slope = zip(*(background_line_integrals(v.reshape(1, 1, 1), shares, beam) for v in values))
    assert float((found[1] - found[0]) / 0.001) == pytest.approx(1 / float(slope[0]), rel=1e-3)


def test_mineral_that_is_known_hardens_as_calcium_does():
    beam = BeamModel.polyenergetic([], SPECTRUM)
    rod, water = calcium_in_water(200), material("water")
    measured = torch.full((1, 1, 1), transmission([(rod, 16.0), (water, 60.0)]))
    at_reference = [float(m.attenuation((beam.reference_kev,))[0]) for m in (rod, water)]
    truth = 16 * at_reference[0] + 60 * at_reference[1]
    mineral = torch.full((1, 1, 1), 16 * (at_reference[0] - at_reference[1]))
    unaware, _ = background_line_integrals(measured, beam.weights, beam)
    aware, _ = background_line_integrals(measured, beam.weights, beam, mineral=mineral)
    assert abs(float(aware) - truth) < 0.2 * abs(float(unaware) - truth)
    assert float(aware) == pytest.approx(truth, rel=2e-3)


def test_one_energy_subtracts_the_metal():
    beam = BeamModel.monoenergetic([0.1, 0.3])
    lengths = torch.tensor([2.0, 1.0]).reshape(2, 1, 1, 1).expand(2, 1, 2, 2)
    found, slope = background_line_integrals(torch.full((1, 2, 2), 1.5), behind_metal(lengths, beam), beam)
    assert torch.allclose(found, torch.full((1, 2, 2), 1.0))
    assert (slope == 1).all()


def test_sub_pixels_average_the_transmission_and_not_the_length():
    beam = BeamModel.monoenergetic([0.5])
    lengths = torch.tensor([[0.0, 10.0], [0.0, 10.0]]).reshape(1, 1, 2, 2)
    share = behind_metal(lengths, beam, pooling=2)
    assert share.item() == pytest.approx(0.5 * (1 + torch.exp(torch.tensor(-5.0)).item()), rel=1e-6)


def test_mineral_is_what_is_clearly_above_water():
    beam = BeamModel.polyenergetic([], SPECTRUM)
    volume = torch.full((5, 5, 12), beam.water)
    volume[..., 6:] *= 1.5
    part = mineral_part(volume, beam)
    assert (part[..., :5] == 0).all()
    assert torch.allclose(part[..., 7:], torch.tensor(0.5 * beam.water))


def test_path_lengths_must_have_a_material_each():
    with pytest.raises(ValueError, match=r"path_lengths must have shape \(1, V, rows, cols\)"):
        behind_metal(torch.zeros(2, 1, 1, 1), BeamModel.monoenergetic([0.1]))

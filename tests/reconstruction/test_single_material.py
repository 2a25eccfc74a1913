"""Scans of one material alone."""

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import ReconstructionFiles, reconstruct_files, resolve_options
from torchkcreg.geometry import circular_geometry
from torchkcreg.io import read_volume, write_geometry, write_projections, write_spectrum
from torchkcreg.physics import Beam, material, tungsten_spectrum
from torchkcreg.reconstruction import path_lengths_through
from torchkcreg.simulation import Cylinder, chord_image


def test_path_lengths_come_back_through_any_material():
    spectrum, lengths = tungsten_spectrum(120), torch.linspace(0, 30, 301, dtype=torch.float64)
    for name in ("steel", "titanium"):
        beam = Beam.of([material(name)], spectrum, num_bins=None)
        passed = beam.transmission(lengths[None, None, None, None])[0, 0, 0]
        found = path_lengths_through(passed, material(name), spectrum)
        torch.testing.assert_close(found, lengths, atol=2e-3, rtol=1e-4)


def test_noise_about_no_material_has_no_bias():
    noisy = 1 + 0.01 * torch.randn(100_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = path_lengths_through(noisy, material("steel"), tungsten_spectrum(90))
    assert float(found.mean().abs()) < 0.02 * float(found.std())


def bench(folder):
    """A steel rod on a bench, imaged all around."""
    spectrum = tungsten_spectrum(120)
    geometry = circular_geometry(
        list(range(0, 360, 3)), sad=400.0, sdd=500.0, det_shape=(16, 48), pixel_spacing=(0.6, 0.6)
    )
    rod = Cylinder(torch.tensor([0.0, 0.0, -30.0]), torch.tensor([0.0, 0.0, 30.0]), 4.0)
    chords = torch.stack([chord_image(rod, matrix, geometry.det_shape) for matrix in geometry.projection_matrices])
    passed = Beam.of([material("steel")], spectrum, num_bins=None).transmission(chords[None, None])[0]
    write_geometry(folder / "geometry.json", geometry)
    write_projections(folder / "rod.npz", intensity=(passed * 60000).round().to(torch.int32), open_beam=60000.0)
    write_spectrum(folder / "spectrum.csv", spectrum)
    return ReconstructionFiles(
        geometry=folder / "geometry.json", projections=folder / "rod.npz", spectrum=folder / "spectrum.csv"
    )


def test_a_rod_on_a_bench_is_metal_through_and_through(tmp_path):
    options = {"spacing_mm": 0.5, "size_mm": (14.0, 14.0, 4.0), "scatter": "none"}
    files = bench(tmp_path)
    values = {}
    for name, more in (("cupped", {}), ("share", {"single_material": "steel"})):
        reconstruct_files(files, tmp_path / name, resolve_options(options | more), figures=False)
        volume, _ = read_volume(tmp_path / name / "volume.mha")
        middle = volume[4]
        values[name] = float(middle[13:15, 13:15].mean()), float(middle[13:15, 8:10].mean())
    inside, near = values["share"]
    assert inside == pytest.approx(1.0, abs=0.03)
    assert near == pytest.approx(1.0, abs=0.03)
    assert values["cupped"][0] < 0.95 * values["cupped"][1]  # the question is not idle
    assert not (tmp_path / "share" / "volume_hu.mha").exists()


def test_a_single_material_goes_with_fdk_and_must_be_known(tmp_path, capsys):
    bench(tmp_path)
    command = ["reconstruct", "--geometry", str(tmp_path / "geometry.json"), "--projections", str(tmp_path / "rod.npz")]
    command += ["--out", str(tmp_path / "out"), "--single-material"]
    assert main([*command, "steel", "--method", "pwls"]) == 2
    assert "method fdk, not pwls" in capsys.readouterr().err
    assert main([*command, "unobtainium"]) == 2
    assert "material must be one of" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

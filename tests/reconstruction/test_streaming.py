"""Scans of which some views are read at a time: the same volumes, and what cannot be streamed is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.io import ProjectionFile, read_projections, read_volume, write_geometry, write_projections
from torchkcreg.physics import Veil, material, tungsten_spectrum
from torchkcreg.reconstruction import BeamModel, PWLSConfig, component_path_lengths, fdk, reconstruct
from torchkcreg.simulation.solids import Sphere

SCAN = {"sad": 404, "sdd": 538, "det_shape": (24, 36), "pixel_spacing": (2.5, 2.5)}
GRID = VolumeGrid.centered((8, 16, 16), 3.0)


@pytest.fixture(scope="module")
def scan(line_integrals_of) -> tuple[ConeBeamGeometry, torch.Tensor]:
    geometry = circular_geometry(range(0, 360, 8), **SCAN)
    return geometry, line_integrals_of([(Sphere(torch.tensor([4.0, -3.0, 2.0]), 15.0), 0.02)], geometry)


def tilted(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 1], turn[1, 0] = -0.03, 0.03
    return ConeBeamGeometry(turn @ geometry.projection_matrices, geometry.det_shape, geometry.pixel_spacing)


@pytest.mark.parametrize("kind", ["aligned", "tilted", "two spots"])
def test_views_that_are_asked_for_give_the_volume_of_all_of_them(scan, kind):
    geometry, images = scan
    if kind == "tilted":
        geometry = tilted(geometry)
    if kind == "two spots":
        sources = ["a", "b"] * 23
        geometry = ConeBeamGeometry(
            geometry.projection_matrices, geometry.det_shape, geometry.pixel_spacing, sources=sources[: len(images)]
        )
    asked: list[int] = []

    def read(views: list[int]) -> torch.Tensor:
        asked.extend(views)
        return images[views]

    streamed = fdk(read, geometry, GRID)
    torch.testing.assert_close(streamed, fdk(images, geometry, GRID), rtol=0, atol=1e-7)
    assert sorted(asked) == list(range(len(images)))  # each once
    assert float(streamed.max()) > 0.01


def test_a_function_that_gives_no_images_is_refused(scan):
    geometry, images = scan
    with pytest.raises(ValueError, match="must have shape"):
        fdk(lambda views: images[views][:, :4], geometry, GRID)
    with pytest.raises(ValueError, match="must be finite"):
        fdk(lambda views: images[views] / 0, geometry, GRID)


@pytest.mark.parametrize("suffix", [".npy", ".mha", ".nrrd"])
def test_a_file_gives_some_of_its_views(scan, tmp_path, suffix):
    counts = (40000 * torch.exp(-scan[1])).numpy().astype(np.uint16)
    counts[7, 3, 4] = 0  # a pixel without a measurement
    path = tmp_path / f"scan{suffix}"
    if suffix == ".npy":
        np.save(path, counts)
    else:
        sitk.WriteImage(sitk.GetImageFromArray(counts), str(path))
    file, whole = ProjectionFile(path, open_beam=40000.0), read_projections(path, open_beam=40000.0)
    assert len(file) == len(scan[1])
    part = file.read([7, 2])
    torch.testing.assert_close(part.line_integrals, whole.line_integrals[[7, 2]])
    assert torch.equal(part.mask, whole.mask[[7, 2]]) and not part.mask[0, 3, 4]
    with pytest.raises(ValueError, match="there is no view 45"):
        file.read([45])


def test_files_that_cannot_be_read_in_parts_are_refused(tmp_path):
    write_projections(tmp_path / "scan.npz", line_integrals=torch.ones(2, 3, 4))
    with pytest.raises(ValueError, match="single views cannot be read from"):
        ProjectionFile(tmp_path / "scan.npz")
    (tmp_path / "scan.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match=r"scan\.npy: "):
        ProjectionFile(tmp_path / "scan.npy")
    np.save(tmp_path / "number.npy", np.float32(3))
    with pytest.raises(ValueError, match=r"number\.npy: "):
        ProjectionFile(tmp_path / "number.npy")
    with pytest.raises(FileNotFoundError):
        ProjectionFile(tmp_path / "nothing.npy")


def test_known_components_are_reconstructed_from_views_as_they_are_read(scan, tmp_path):
    """Two passes of KC-Rec, arrays in files: the volume, line integrals and scatter of those in memory."""
    geometry, images = scan
    metal = [KnownComponent.from_mesh(trimesh.creation.box((6.0, 3.0, 6.0)), "titanium", pitch=0.5)]
    beam = BeamModel.polyenergetic([material("titanium")], tungsten_spectrum(90))
    transmission = torch.exp(-images - 0.2 * component_path_lengths(metal, geometry)[0])
    mask = torch.ones_like(images)
    mask[:, 3, 4] = 0
    options = {"config": PWLSConfig(iterations=3, subsets=5), "components": metal, "scatter": Veil(0.1, 20.0)}
    whole = reconstruct(transmission, geometry, GRID, beam, mask=mask, **options)
    read = lambda views: (transmission[views], mask[views])  # noqa: E731
    streamed = reconstruct(read, geometry, GRID, beam, folder=tmp_path, **options)
    torch.testing.assert_close(streamed.volume, whole.volume)
    torch.testing.assert_close(streamed.data.line_integrals, whole.data.line_integrals)
    torch.testing.assert_close(streamed.scatter, whole.scatter)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="also returns their masks"):
        reconstruct(read, geometry, GRID, beam, mask=mask, **options)
    with pytest.raises(ValueError, match="transmission must have shape"):
        reconstruct(transmission[:4], geometry, GRID, beam, **options)


def test_a_disk_without_room_is_told_before_anything_is_written(scan, tmp_path, monkeypatch):
    geometry, images = scan
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match=r"has room for 0\.0 GiB"):
        reconstruct(torch.exp(-images), geometry, GRID, BeamModel.monoenergetic([]), folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_command_line_streams(scan, tmp_path, capsys):
    geometry, images = scan
    write_geometry(tmp_path / "geometry.json", geometry)
    np.save(tmp_path / "scan.npy", (1000 * torch.exp(-images)).numpy())
    files = ["--geometry", str(tmp_path / "geometry.json"), "--projections", str(tmp_path / "scan.npy")]
    options = ["reconstruct", *files, "--open-beam", "1000", "--spacing", "4", "--no-figures"]
    assert main([*options, "--scatter", "none", "--out", str(tmp_path / "whole")]) == 0
    assert main([*options, "--scatter", "none", "--stream", "--out", str(tmp_path / "streamed")]) == 0
    torch.testing.assert_close(
        read_volume(tmp_path / "streamed" / "volume.mha")[0], read_volume(tmp_path / "whole" / "volume.mha")[0]
    )
    iterated = ["--method", "pwls", "--iterations", "4", "--subsets", "5", "--scatter", "none"]
    assert main([*options, *iterated, "--out", str(tmp_path / "pwls")]) == 0
    assert main([*options, *iterated, "--stream", "--out", str(tmp_path / "streamed_pwls")]) == 0
    torch.testing.assert_close(
        read_volume(tmp_path / "streamed_pwls" / "volume.mha")[0], read_volume(tmp_path / "pwls" / "volume.mha")[0]
    )
    assert not list((tmp_path / "streamed_pwls").glob("array*"))
    assert main([*options, "--stream", "--out", str(tmp_path / "with_veil")]) == 0  # fitted to a sample of the views
    refused = {
        ("--scatter", "run", "--run", str(tmp_path)): "need all views at once",
    }
    (tmp_path / "config.yaml").write_text("files: {}\n")
    for flags, reason in refused.items():
        assert main([*options, "--stream", *flags, "--out", str(tmp_path / "not")]) == 2
        assert reason in capsys.readouterr().err
    write_geometry(tmp_path / "geometry.json", geometry.select(range(20)))
    assert main([*options, "--stream", "--out", str(tmp_path / "not")]) == 2
    assert "has 45 views, the geometry has 20" in capsys.readouterr().err

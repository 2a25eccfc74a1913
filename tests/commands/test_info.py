import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchkcreg.cli import main
from torchkcreg.commands import describe, describe_installation
from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_geometry, write_geometry, write_init, write_mesh, write_spectrum, write_volume
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.simulation import locking_plate


def test_a_mesh_is_described_by_size_and_volume(tmp_path):
    plate = locking_plate()
    write_mesh(tmp_path / "plate.stl", plate)
    text = describe(tmp_path / "plate.stl")
    assert f"{len(plate.faces)} triangles, 13.5 x 4.6 x 188 mm about (0, 0, 0)" in text
    assert f"volume {plate.volume:.6g} mm^3" in text


def test_a_geometry_is_described_view_by_view(small_case):
    lines = describe(small_case / "geometry.json").splitlines()
    assert "3 views of 192 x 80 pixels" in lines[0]
    assert "source to detector 538 mm" in lines[0]
    assert lines[2].strip() == "view 1: 48 degrees, source T2 at (270.3, 300.2, 0.0) mm"


def test_a_geometry_is_drawn(small_case, tmp_path, capsys):
    assert main(["info", str(small_case / "geometry.json"), "--picture", str(tmp_path / "g.png")]) == 0
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")
    assert "3 views" in capsys.readouterr().out
    assert main(["info", "--picture", str(tmp_path / "g.png")]) == 2
    assert "of one geometry, got 0 files" in capsys.readouterr().err


def test_projections_are_described_with_what_is_masked(tmp_path):
    intensity = np.full((2, 8, 9), 100.0, dtype=np.float32)
    intensity[0, 0, 0] = 0.0
    np.savez(tmp_path / "p.npz", intensity=intensity, open_beam=1000.0)
    text = describe(tmp_path / "p.npz")
    assert "2 views of 8 x 9 pixels, line integrals 2.3 to 2.3" in text
    assert "1 pixels masked (not positive)" in text


def test_what_cannot_be_described_is_an_error(small_case, tmp_path):
    (tmp_path / "notes.md").write_text("90 kV")
    with pytest.raises(ValueError, match="cannot be described"):
        describe(tmp_path / "notes.md")
    (tmp_path / "o.json").write_text('{"tube": 90}')
    assert "JSON with tube: neither geometry" in describe(tmp_path / "o.json")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        describe(tmp_path / "nothing.stl")
    with pytest.raises(FileNotFoundError, match="neither results nor a scan"):
        describe(tmp_path)


def test_every_file_that_is_read_is_described(small_case, tmp_path):
    assert "screws, 6 of steel" in describe(small_case / "screws.json")
    assert "points, " in describe(small_case / "before.csv")
    write_spectrum(tmp_path / "s.csv", tungsten_spectrum(70))
    assert "energies from" in describe(tmp_path / "s.csv")
    geometry = read_geometry(small_case / "geometry.json")
    for name, what in (("g.xml", "RTK's geometry"), ("g.npy", "3 x 4 matrices"), ("g.csv", "3 x 4 matrices")):
        write_geometry(tmp_path / name, geometry)
        lines = describe(tmp_path / name).splitlines()
        assert what in lines[0] and "view 1" in lines[2] and "(270.3, 300.2, 0.0) mm" in lines[2]
    write_init(tmp_path / "i.json", torch.eye(4, dtype=torch.float64))
    assert "origin to (0, 0, 0) mm" in describe(tmp_path / "i.json")
    write_volume(tmp_path / "v.mha", torch.rand(3, 4, 5), VolumeGrid((3, 4, 5), 1.5))
    assert "3 views of 4 x 5 pixels" in describe(tmp_path / "v.mha")
    sitk.WriteImage(sitk.GetImageFromArray(np.full((3, 4, 5), 9, np.int16)), str(tmp_path / "ct.mha"))
    assert "volume, 5 x 4 x 3 voxels of 1 x 1 x 1 mm" in describe(tmp_path / "ct.mha")
    (tmp_path / "scan.yaml").write_text("images: v.mha\n")
    assert "3 views of 4 x 5 pixels" in describe(tmp_path / "scan.yaml")
    (tmp_path / "c.yaml").write_text("material: steel\n")
    assert describe(tmp_path / "c.yaml").endswith("configuration with material")
    sitk.WriteImage(sitk.GetImageFromArray(np.full((3, 4, 5), 9, np.float32)), str(tmp_path / "s.nhdr"))
    assert "3 views of 4 x 5 pixels" in describe(tmp_path / "s.nhdr")
    sitk.WriteImage(sitk.GetImageFromArray(np.arange(20, dtype=np.uint16).reshape(1, 4, 5)), str(tmp_path / "a.dcm"))
    (tmp_path / "a.dcm").rename(tmp_path / "IM0001")  # DICOM without an ending, and without a geometry
    assert "1 views of 4 x 5 pixels" in describe(tmp_path / "IM0001", open_beam=100.0)
    (tmp_path / "volume").mkdir()
    write_volume(tmp_path / "volume" / "volume.mha", torch.rand(3, 4, 5), VolumeGrid((3, 4, 5), 1.5))
    assert "reconstruction; volume.mha is a volume, 5 x 4 x 3" in describe(tmp_path / "volume")
    (tmp_path / "images").mkdir()
    for index in range(2):
        image = sitk.GetImageFromArray(np.random.default_rng(index).random((4, 5)).astype(np.float32))
        sitk.WriteImage(image, str(tmp_path / "images" / f"{index}.tif"))
    assert "2 views of 4 x 5 pixels" in describe(tmp_path / "images")


def test_the_installation_names_versions_threads_and_the_projectors_backend():
    lines = describe_installation().splitlines()
    names = [line.split()[0] for line in lines]
    assert {"torchkcreg", "torch", "numpy", "python", "threads", "projector"} <= set(names)
    assert lines[-1].startswith(("projector backend cpp (C++ kernels", "projector backend torch (the readable"))

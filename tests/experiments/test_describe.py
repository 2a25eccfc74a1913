import numpy as np
import pytest

from torchkcreg.experiments import describe, describe_installation
from torchkcreg.io import write_mesh
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


def test_projections_are_described_with_what_is_masked(tmp_path):
    intensity = np.full((2, 8, 9), 100.0, dtype=np.float32)
    intensity[0, 0, 0] = 0.0
    np.savez(tmp_path / "p.npz", intensity=intensity, open_beam=1000.0)
    text = describe(tmp_path / "p.npz")
    assert "2 views of 8 x 9 pixels, line integrals 2.3 to 2.3" in text
    assert "1 pixels masked (not positive)" in text


def test_what_cannot_be_described_is_an_error(small_case, tmp_path):
    with pytest.raises(ValueError, match="no geometry"):
        describe(small_case / "screws.json")
    with pytest.raises(ValueError, match="none of what can be described"):
        describe(small_case / "before.csv")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        describe(tmp_path / "nothing.stl")
    with pytest.raises(FileNotFoundError):
        describe(tmp_path)


def test_the_installation_names_versions_threads_and_the_projectors_backend():
    lines = describe_installation().splitlines()
    names = [line.split()[0] for line in lines]
    assert {"torchkcreg", "torch", "numpy", "python", "threads", "projector"} <= set(names)
    assert lines[-1].startswith(("projector backend cpp (C++ kernels", "projector backend torch (the readable"))

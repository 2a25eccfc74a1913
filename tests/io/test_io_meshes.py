import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.implant import find_holes
from torchkcreg.io import read_mesh, write_mesh, write_point_cloud_ply


@pytest.fixture
def plate():
    return trimesh.creation.box((12.0, 4.0, 90.0))


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off"])
def test_a_mesh_comes_back_closed_with_its_volume(tmp_path, plate, suffix):
    write_mesh(tmp_path / f"plate{suffix}", plate)
    mesh = read_mesh(tmp_path / f"plate{suffix}")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(12 * 4 * 90, rel=1e-6)
    assert mesh.extents == pytest.approx([12, 4, 90], rel=1e-6)


@pytest.mark.parametrize(("unit", "factor"), [("millimeter", 1), ("centimeter", 10), ("inch", 25.4)])
def test_a_3mf_is_converted_from_the_unit_that_it_names(tmp_path, plate, unit, factor):
    pytest.importorskip("lxml")
    plate.apply_scale(0.4)
    plate.export(tmp_path / "mm.3mf")
    with zipfile.ZipFile(tmp_path / "mm.3mf") as source, zipfile.ZipFile(tmp_path / "plate.3mf", "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b'unit="millimeter"', f'unit="{unit}"'.encode()))
    mesh = read_mesh(tmp_path / "plate.3mf")
    assert mesh.extents == pytest.approx([4.8 * factor, 1.6 * factor, 36 * factor], rel=1e-6)


def test_several_bodies_are_one_surface(tmp_path, plate):
    screw = trimesh.creation.cylinder(2.0, 30.0)
    screw.apply_translation([50, 0, 0])
    trimesh.util.concatenate([plate, screw]).export(tmp_path / "both.stl")
    mesh = read_mesh(tmp_path / "both.stl")
    assert mesh.body_count == 2
    assert mesh.volume == pytest.approx(plate.volume + screw.volume, rel=1e-5)


def test_a_mesh_turned_inside_out_is_turned_back(tmp_path, plate):
    plate.invert()
    plate.export(tmp_path / "plate.stl")
    assert read_mesh(tmp_path / "plate.stl").volume == pytest.approx(12 * 4 * 90, rel=1e-6)


def test_a_face_turned_inside_out_is_turned_back(tmp_path, plate):
    plate.faces[3] = plate.faces[3][::-1]
    plate.export(tmp_path / "plate.stl")
    assert read_mesh(tmp_path / "plate.stl").volume == pytest.approx(12 * 4 * 90, rel=1e-6)


def test_open_edges_are_counted(tmp_path, plate):
    plate.update_faces(np.arange(len(plate.faces)) != 5)
    plate.export(tmp_path / "open.stl")
    with pytest.raises(ValueError, match=r"mesh file .*open\.stl: mesh must be closed, got 3 open edges"):
        read_mesh(tmp_path / "open.stl")


@pytest.mark.parametrize(("factor", "message"), [(1e-3, "probably in metres"), (25.4, "probably not in mm")])
def test_an_unlikely_size_gives_a_warning_with_the_size(tmp_path, plate, factor, message):
    plate.apply_scale(factor)
    plate.export(tmp_path / "plate.stl")
    with pytest.warns(UserWarning, match=rf"plate\.stl is .* x {90 * factor:.4g} mm: it is {message}"):
        read_mesh(tmp_path / "plate.stl")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", b"", "a.stl"),
        ("a.stl", b"solid nothing\nendsolid nothing\n", "a.stl"),
        ("a.obj", b"v 0 0 0\n", "a.obj"),
        ("a.ply", b"ply\nnonsense\n", "a.ply"),
        ("a.3mf", b"PK\x03\x04 this is nothing", "a.3mf cannot be read"),
        ("a.igs", b"S 1", "must be one of .stl"),
    ],
)
def test_a_file_without_a_mesh_is_refused_by_name(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"^mesh file .*{message}") as caught:
        read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_missing_mesh_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mesh file .*none\.stl does not exist"):
        read_mesh(tmp_path / "none.stl")


def test_a_mesh_is_not_written_under_an_unknown_suffix(tmp_path, plate):
    with pytest.raises(ValueError, match=r"meshes are written as"):
        write_mesh(tmp_path / "plate.step", plate)


def test_a_cloud_with_displacements_is_a_ply_that_others_read(tmp_path):
    points = torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    displacement = torch.tensor([[3.0, 0.0, 4.0]]).expand(100, 3)
    write_point_cloud_ply(tmp_path / "cloud.ply", points, displacement, torch.linspace(0, 1, 100))
    cloud = trimesh.load(tmp_path / "cloud.ply")
    assert np.allclose(cloud.vertices, points.numpy())
    fields = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(fields["dz"].ravel(), np.full(100, 4, np.float32))
    assert fields["displacement"].ravel() == pytest.approx(5.0)
    assert fields["std"].ravel() == pytest.approx(np.linspace(0, 1, 100), abs=1e-6)


def test_a_cloud_that_is_none_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="points must have shape"):
        write_point_cloud_ply(tmp_path / "c.ply", torch.zeros(0, 3))
    with pytest.raises(ValueError, match="displacement must have shape"):
        write_point_cloud_ply(tmp_path / "c.ply", torch.zeros(2, 3), torch.zeros(3, 3))
    with pytest.raises(ValueError, match="std must have shape"):
        write_point_cloud_ply(tmp_path / "c.ply", torch.zeros(2, 3), None, torch.zeros(3))
    assert list(tmp_path.iterdir()) == []


def test_a_step_file_is_a_surface_in_mm_whatever_its_unit(tmp_path):
    pytest.importorskip("cascadio")
    path = Path(__file__).with_name("plate_with_a_hole.step")
    plate = read_mesh(path)
    assert plate.extents == pytest.approx([12, 4, 90], abs=1e-4)
    assert plate.volume == pytest.approx(12 * 4 * 90 - np.pi * 2.5**2 * 4, rel=1e-5)
    (hole,) = find_holes(plate)
    assert hole.radius == pytest.approx(2.5, abs=0.01)
    metres = path.read_text().replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)")
    (tmp_path / "m.stp").write_text(metres)
    with pytest.warns(UserWarning, match="probably not in mm"):
        assert read_mesh(tmp_path / "m.stp").extents == pytest.approx([12000, 4000, 90000], rel=1e-6)


def test_a_damaged_step_file_is_refused_and_a_missing_reader_is_named(tmp_path, monkeypatch):
    pytest.importorskip("cascadio")
    (tmp_path / "a.step").write_text("ISO-10303-21;\nnothing")
    with pytest.raises(ValueError, match=r"a.step cannot be read: it .*(STEP file with a body|no surface)"):
        read_mesh(tmp_path / "a.step")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="need cascadio"):
        read_mesh(tmp_path / "a.step")

import pytest
import torch
import trimesh

from torchkcreg.io import read_reference, write_point_cloud_ply, write_points

POINTS = torch.tensor([[0.0, 1.0, 2.0], [3.0, 4.0, 5.5]], dtype=torch.float64)


def test_points_come_from_csv_xyz_and_ply_without_faces(tmp_path):
    write_points(tmp_path / "a.csv", POINTS)
    (tmp_path / "b.xyz").write_text("0 1 2\n3 4 5.5\n")
    write_point_cloud_ply(tmp_path / "c.ply", POINTS, 0 * POINTS)
    for name in ("a.csv", "b.xyz", "c.ply"):
        torch.testing.assert_close(read_reference(tmp_path / name), POINTS)


def test_meshes_come_from_stl_and_ply_with_faces(tmp_path):
    box = trimesh.creation.box((10.0, 4.0, 2.0))
    for name in ("a.stl", "b.ply"):
        box.export(tmp_path / name)
        assert read_reference(tmp_path / name).volume == pytest.approx(80)


def test_a_file_without_a_shape_is_an_error_that_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"reference file .*no\.stl does not exist"):
        read_reference(tmp_path / "no.stl")
    (tmp_path / "a.dat").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"a\.dat must be one of"):
        read_reference(tmp_path / "a.dat")
    (tmp_path / "empty.csv").write_text("x,y,z\n")
    with pytest.raises(ValueError, match="holds no rows"):
        read_reference(tmp_path / "empty.csv")
    (tmp_path / "nan.xyz").write_text("0 1 2\n3 nan 5\n")
    with pytest.raises(ValueError, match="line 2"):
        read_reference(tmp_path / "nan.xyz")
    write_point_cloud_ply(tmp_path / "nan.ply", POINTS * torch.tensor([1.0, 1.0, float("nan")]))
    with pytest.raises(ValueError, match=r"nan\.ply must hold finite points, but number 0 is not"):
        read_reference(tmp_path / "nan.ply")
    (tmp_path / "bad.ply").write_text("ply\nnonsense\n")
    with pytest.raises(ValueError, match=r"bad\.ply"):
        read_reference(tmp_path / "bad.ply")

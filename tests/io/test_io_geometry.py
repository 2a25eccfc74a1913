import json

import pytest
import torch

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner
from torchkcreg.io import geometry_to_dict, read_geometry, write_geometry


@pytest.fixture
def geometry():
    scanner = MultisourceScanner()
    return scanner.geometry().select([0, 1, 2, 77])


def written(tmp_path, content):
    path = tmp_path / "geometry.json"
    path.write_text(json.dumps(content))
    return path


def test_a_geometry_comes_back_as_it_was_written(tmp_path, geometry):
    write_geometry(tmp_path / "g.json", geometry)
    again = read_geometry(tmp_path / "g.json")
    torch.testing.assert_close(again.projection_matrices, geometry.projection_matrices, rtol=1e-14, atol=1e-12)
    assert tuple(again.det_shape) == tuple(geometry.det_shape)
    assert tuple(again.pixel_spacing) == tuple(geometry.pixel_spacing)
    assert again.sources == geometry.sources
    assert again.angles_deg == geometry.angles_deg


def test_the_file_tells_the_source_and_the_distances_of_the_scanner(geometry):
    content = geometry_to_dict(geometry)
    assert content["sad_mm"] == pytest.approx(404)
    assert content["sdd_mm"] == pytest.approx(538)
    assert [view["source_z_mm"] for view in content["views"]] == pytest.approx(geometry.source_positions[:, 2].tolist())


def test_views_at_different_distances_have_no_common_one(geometry):
    closer = geometry.projection_matrices.clone()
    closer[1] = geometry.projection_matrices[1] @ torch.tensor(
        [[1.0, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64
    )
    content = geometry_to_dict(ConeBeamGeometry(closer, geometry.det_shape, geometry.pixel_spacing))
    assert "sad_mm" not in content
    assert content["sdd_mm"] == pytest.approx(538)


def test_a_geometry_without_labels_and_with_oblong_pixels_comes_back(tmp_path):
    matrices = torch.tensor([[[-1000.0, 0, 50, 20000], [0, 500.0, 25, 10000], [0, 0, 1.0, 400]]], dtype=torch.float64)
    write_geometry(tmp_path / "g.json", ConeBeamGeometry(matrices, (40, 80), (1.0, 0.5)))
    again = read_geometry(tmp_path / "g.json")
    torch.testing.assert_close(again.projection_matrices, matrices)
    assert tuple(again.pixel_spacing) == (1.0, 0.5)
    assert again.sources is None
    assert again.angles_deg is None


def test_the_scale_of_a_matrix_does_not_matter(tmp_path, geometry):
    content = geometry_to_dict(geometry)
    for view in content["views"]:
        view["projection_matrix"] = [[-7.5 * x for x in row] for row in view["projection_matrix"]]
    again = read_geometry(written(tmp_path, content))
    torch.testing.assert_close(again.projection_matrices, geometry.projection_matrices)


def test_a_source_that_the_matrix_contradicts_is_refused(tmp_path, geometry):
    content = geometry_to_dict(geometry)
    content["views"][2]["source_mm"][0] += 0.09
    read_geometry(written(tmp_path, content))
    content["views"][2]["source_mm"][0] += 0.02
    with pytest.raises(ValueError, match=r"geometry\.json: source_mm of view 2 is 0\.11 mm from"):
        read_geometry(written(tmp_path, content))


def edit(content, key, value):
    if value is None:
        content.pop(key)
    else:
        content[key] = value


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("views", None, "views"),
        ("views", [], "views"),
        ("views", [{}], "view 0 has no projection_matrix"),
        ("rows", 0, "rows must be a positive whole number"),
        ("rows", 7.5, "rows must be a positive whole number"),
        ("cols", True, "cols must be a positive whole number"),
        ("cols", None, "cols must be a positive whole number"),
        ("pixel_pitch_mm", None, "pixel_pitch_mm must be a positive number"),
        ("pixel_pitch_mm", -0.4, "pixel_pitch_mm must be a positive number"),
        ("pixel_pitch_mm", [0.4], r"pixel_pitch_mm must be a number or \[dv, du\]"),
        ("sdd_mm", 600, "sdd_mm is 600, but"),
        ("sdd_mm", "far", "sdd_mm must be a positive number"),
    ],
)
def test_a_bad_key_is_refused_by_name(tmp_path, geometry, key, value, message):
    content = geometry_to_dict(geometry)
    edit(content, key, value)
    with pytest.raises(ValueError, match=rf"^geometry file .*geometry\.json: .*{message}") as caught:
        read_geometry(written(tmp_path, content))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("projection_matrix", [[1, 0, 0, 0]] * 2, "projection_matrix of view 1 must be 3 x 4 numbers"),
        ("projection_matrix", [[1, 0, 0, 0]] * 3, "projection_matrix of view 1 is singular"),
        ("projection_matrix", [[0, 0, 0, 0]] * 3, "projection_matrix of view 1 is singular"),
        ("projection_matrix", [["a"] * 4] * 3, "projection_matrix of view 1 must be 3 x 4 numbers"),
        ("source_mm", [1, 2], "source_mm of view 1 must be 3 numbers"),
        ("source_z_mm", 55, "source_z_mm of view 1 is 55"),
        ("angle_deg", "left", "angle_deg of view 1 must be a finite number"),
        ("angle_deg", None, "angle_deg must be in every view or in none, but view 1 lacks it"),
        ("source", None, "source must be in every view or in none, but view 1 lacks it"),
    ],
)
def test_a_bad_view_is_refused_by_number_and_key(tmp_path, geometry, key, value, message):
    content = geometry_to_dict(geometry)
    edit(content["views"][1], key, value)
    with pytest.raises(ValueError, match=rf"^geometry file .*geometry\.json: {message}"):
        read_geometry(written(tmp_path, content))


def test_infinite_entries_are_refused(tmp_path, geometry):
    content = geometry_to_dict(geometry)
    content["views"][0]["projection_matrix"][0][0] = float("inf")
    with pytest.raises(ValueError, match="projection_matrix of view 0 must be finite"):
        read_geometry(written(tmp_path, content))


def test_a_missing_geometry_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"geometry file .*nowhere\.json does not exist"):
        read_geometry(tmp_path / "nowhere.json")

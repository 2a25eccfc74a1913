from __future__ import annotations

import numpy as np
import pytest
import trimesh

from torchkcreg.implant import closed_triangles


def _signed_volume(triangles: np.ndarray) -> float:
    return float(np.linalg.det(triangles).sum() / 6)


def test_an_open_mesh_is_refused_with_the_number_of_its_open_edges() -> None:
    ball = trimesh.creation.icosphere(2)
    ball.update_faces(np.arange(len(ball.faces)) != 7)
    with pytest.raises(ValueError, match="3 open edges"):
        closed_triangles(ball)


def test_an_inverted_mesh_is_turned_right_and_left_as_it_was() -> None:
    ball = trimesh.creation.icosphere(2)
    expected = ball.volume
    ball.invert()
    assert _signed_volume(closed_triangles(ball)) == pytest.approx(expected)
    assert ball.volume == pytest.approx(-expected)


def test_mixed_winding_is_repaired() -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    faces = box.faces.copy()
    faces[::3] = faces[::3, ::-1]
    mixed = trimesh.Trimesh(box.vertices, faces, process=False)
    assert _signed_volume(closed_triangles(mixed)) == pytest.approx(6.0)


def test_triangles_that_do_not_share_vertices_are_joined_as_stl_files_need() -> None:
    ball = trimesh.creation.icosphere(2)
    soup = trimesh.Trimesh(ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3), process=False)
    assert len(closed_triangles(soup)) == len(ball.faces)
    assert len(soup.vertices) == 3 * len(ball.faces)


def test_solids_that_touch_along_an_edge_are_closed() -> None:
    touching = trimesh.util.concatenate(
        [trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]]), trimesh.creation.box(bounds=[[1, 1, 0], [2, 2, 1]])]
    )
    assert _signed_volume(closed_triangles(touching)) == pytest.approx(2.0)


def test_what_is_no_solid_is_refused() -> None:
    with pytest.raises(ValueError, match="mesh must be a trimesh"):
        closed_triangles(np.zeros((4, 3)))
    with pytest.raises(ValueError, match="mesh must be a trimesh"):
        closed_triangles(trimesh.Trimesh())
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 1]], process=False)
    with pytest.raises(ValueError, match="enclose a volume"):
        closed_triangles(sheet)
    ball = trimesh.creation.icosphere(1)
    ball.vertices[3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        closed_triangles(ball)

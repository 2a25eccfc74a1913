import json
import pickle

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.evaluation import evaluate_shape
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud, deformed_surface

MOTION = rigid_matrix(torch.tensor([0.004, -0.006, 0.008]).double(), torch.tensor([0.2, -0.1, 0.15]).double())


@pytest.fixture(scope="module")
def body():
    """A hook without symmetry, its edges split."""
    outline = [(0, 0), (30, 0), (30, 5), (12, 5), (12, 9), (5, 9), (5, 5), (0, 5)]
    faces = trimesh.creation.extrude_triangulation(np.array(outline), _FAN, 4.0)
    return faces.subdivide_to_size(3.0)


_FAN = [(0, 6, 7), (0, 3, 6), (3, 5, 6), (3, 4, 5), (0, 1, 3), (1, 2, 3)]


@pytest.fixture(scope="module")
def nodes(body):
    return ImplantPointCloud.from_mesh(body, 0.5, dtype=torch.float64).points


def moved(mesh, mapping):
    vertices = mapping(torch.tensor(np.asarray(mesh.vertices)))
    return trimesh.Trimesh(vertices.numpy(), mesh.faces, process=False)


def test_a_shape_that_only_moved_has_pose_errors_before_and_none_after(body, nodes):
    reference = moved(body, lambda points: transform_points(MOTION, points))
    found = evaluate_shape(body, nodes, reference, pitch_mm=0.5)
    assert found.reference == "mesh"
    assert found.surface_before.rmse_mm > 0.1
    assert found.surface_after.max_mm < 1e-3
    torch.testing.assert_close(found.alignment @ MOTION, torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-3)
    assert found.angle_deg == pytest.approx(np.degrees(np.linalg.norm([0.004, 0.006, 0.008])), rel=1e-3)


def test_a_shape_that_grew_is_off_by_what_it_grew(body, nodes):
    """Faces move out by 0.1 mm: no rigid motion takes that away, and edges and corners are farther off."""
    normals = torch.tensor(np.asarray(body.face_normals))
    samples, faces = trimesh.sample.sample_surface(body, 20_000, seed=3)
    scan = torch.tensor(np.asarray(samples)) + 0.1 * normals[torch.from_numpy(np.asarray(faces))]
    found = evaluate_shape(body, nodes, scan, pitch_mm=0.5)
    assert found.reference == "surface"
    assert found.surface_after.mean_mm == pytest.approx(0.1, abs=2e-3)
    assert found.surface_after.fwhm_mm < 0.01
    assert found.nodes_after is None


def test_between_lattices_of_one_shape_there_is_the_floor(body, nodes):
    turn = rigid_matrix(torch.tensor([0.5, 0.3, -0.7]).double(), torch.zeros(3).double())
    turned = moved(body, lambda points: transform_points(turn, points))
    lattice = ImplantPointCloud.from_mesh(turned, 0.5, dtype=torch.float64).points
    cloud = transform_points(MOTION @ turn.mT, lattice)
    found = evaluate_shape(body, nodes, cloud)
    assert found.reference == "volume"
    assert found.surface_after is None
    assert found.node_floor == pytest.approx((0.240, 0.25), abs=5e-3)
    assert found.nodes_after.mean_mm == pytest.approx(found.node_floor[0], rel=0.1)
    left = transform_points(found.alignment @ MOTION, nodes) - nodes
    assert left.norm(dim=-1).max() < 0.05


def test_a_reference_in_another_frame_is_brought_here_and_has_no_errors_before(body, nodes):
    far = rigid_matrix(torch.tensor([1.0, 2.0, -0.5]).double(), torch.tensor([50.0, 30.0, -200.0]).double())
    with pytest.warns(UserWarning, match="is in another frame"):
        found = evaluate_shape(body, nodes, moved(body, lambda p: transform_points(far, p)), pitch_mm=0.5)
    assert found.surface_before is None and found.nodes_before is None and found.errors_before is None
    assert found.surface_after.max_mm < 1e-3
    assert found.nodes_after.mean_mm == pytest.approx(found.node_floor[0], rel=0.15)


def test_an_evaluation_is_plain_data_a_table_and_can_be_pickled(body, nodes):
    found = evaluate_shape(body, nodes, moved(body, lambda p: transform_points(MOTION, p)), pitch_mm=0.5)
    content = json.loads(json.dumps(found.to_dict()))
    assert content["surface_after"]["rmse_mm"] == found.surface_after.rmse_mm
    assert content["node_floor_mm"]["mean"] == pytest.approx(0.24, abs=1e-3)
    assert len(found.points) == len(found.errors) == len(found.errors_before)
    assert pickle.loads(pickle.dumps(found)).to_dict() == found.to_dict()
    for line in ("node to surface, before CPD", "node to nearest node, after CPD", "floor between perfect lattices"):
        assert line in str(found)


def test_what_a_cloud_is_can_be_said(body, nodes):
    assert evaluate_shape(body, nodes, nodes[::3], reference_kind="surface").reference == "surface"


def test_metres_are_noticed_and_parts_are_warned_of(body, nodes):
    with pytest.raises(ValueError, match="is the reference in metres"):
        evaluate_shape(body, nodes, 1e-3 * nodes)
    with pytest.warns(UserWarning, match="are they the same part, and all of it"):
        evaluate_shape(body, nodes, nodes[nodes[:, 0] < 20])


def test_references_without_points_or_with_nan_are_refused(body, nodes):
    with pytest.raises(ValueError, match="reference must have shape"):
        evaluate_shape(body, nodes, torch.zeros(0, 3))
    with pytest.raises(ValueError, match="reference must be finite, but row 2 is not"):
        evaluate_shape(body, nodes, torch.where(torch.arange(len(nodes))[:, None] == 2, torch.nan, nodes))


class Bow:
    """Bends everything along x into a parabola."""

    gc = torch.ones(1)

    def warp(self, points):
        return points + torch.stack([0 * points[:, 0], 0 * points[:, 0], points[:, 0] ** 2 / 500], dim=-1)

    def outside(self, points):
        return points[:, 0] < -1e9


def test_a_deformed_surface_bends_between_its_vertices_too():
    box = trimesh.creation.box((100.0, 4.0, 4.0))
    bent = deformed_surface(Bow().warp, box)
    middle = torch.tensor([[0.0, 0.0, 2.0]]).double()
    assert bent.is_watertight
    assert np.abs(trimesh.proximity.closest_point(bent, Bow().warp(middle).numpy())[1]).max() < 0.01
    assert bent.vertices[:, 2].max() == pytest.approx(2 + 50**2 / 500)
    with pytest.raises(ValueError, match="longest_edge_mm must be positive"):
        deformed_surface(Bow().warp, box, longest_edge_mm=0)

import numpy as np
import pytest
import torch
import trimesh
from pycpd import RigidRegistration

from torchkcreg.evaluation import align_to_surface, rigid_coherent_point_drift
from torchkcreg.evaluation.alignment import merged, principal_motions
from torchkcreg.geometry import invert_rigid, rigid_matrix, transform_points


def motion(millimetres, degrees):
    turn, shift = torch.tensor([0.6, -0.48, 0.64]).double(), torch.tensor([0.48, 0.6, -0.64]).double()
    return rigid_matrix(turn * degrees * torch.pi / 180, millimetres * shift)


@pytest.fixture(scope="module")
def body():
    """An L of two boxes, without symmetry."""
    parts = [trimesh.creation.box((12.0, 4.0, 50.0)), trimesh.creation.box((10.0, 4.0, 12.0))]
    parts[1].apply_translation((11.0, 0.0, 12.0))
    return trimesh.util.concatenate(parts)


@pytest.fixture(scope="module")
def cloud(body):
    return torch.tensor(np.asarray(trimesh.sample.sample_surface(body, 6000, seed=0)[0]))


def left_over(found, true, points):
    """Largest distance that the found motion leaves of the true one's inverse."""
    return (transform_points(found, transform_points(true, points)) - points).norm(dim=-1).max().item()


def test_coherent_point_drift_undoes_a_motion_of_the_same_points(cloud):
    points, true = cloud[:300], motion(8, 15)
    assert left_over(rigid_coherent_point_drift(transform_points(true, points), points), true, points) < 0.02


def test_coherent_point_drift_is_pycpds_where_that_finds_no_scale(cloud):
    """Points that only moved have scale one, so both must end in the same place."""
    fixed, moving = cloud[:200].numpy(), transform_points(motion(3, 5), cloud[:200]).numpy()
    theirs = RigidRegistration(X=fixed, Y=moving, max_iterations=100, tolerance=1e-6)
    moved, (scale, _, _) = theirs.register()
    assert scale == pytest.approx(1, abs=1e-4)
    ours = rigid_coherent_point_drift(torch.from_numpy(moving), torch.from_numpy(fixed), iterations=100)
    np.testing.assert_allclose(transform_points(ours, torch.from_numpy(moving)).numpy(), moved, atol=0.02)


def test_coherent_point_drift_does_not_grow_a_smaller_copy(cloud):
    points = cloud[:300]
    smaller = 0.9 * points + 20
    found = rigid_coherent_point_drift(smaller, points, iterations=100)
    rotation = found[:3, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
    assert (transform_points(found, smaller) - points).mean(0).norm() < 0.5  # not so if it had grown on the way


def test_clouds_of_other_samples_come_within_a_mm_and_the_surface_does_the_rest(body, cloud):
    other = torch.tensor(np.asarray(trimesh.sample.sample_surface(body, 9000, seed=7)[0]))
    true = motion(6, 10)
    moved = transform_points(true, other)
    drift = rigid_coherent_point_drift(moved, cloud, num_points=300)
    assert left_over(drift, true, other) < 2.0
    found = align_to_surface(transform_points(drift, moved), body) @ drift
    assert left_over(found, true, other) < 1e-3


def test_outermost_nodes_lie_inside_by_one_depth_that_is_found(body, cloud):
    _, faces = trimesh.sample.sample_surface(body, 6000, seed=0)
    normals = torch.tensor(np.asarray(body.face_normals)[faces])
    inside = (cloud - 0.1 * normals)[normals[:, 1] > -0.5]  # one face is missing: else the depths cancel out
    true = motion(0.4, 0.5)
    found = align_to_surface(transform_points(true, inside), body, inset=True)
    assert left_over(found, true, inside) < 0.05


def test_principal_axes_bring_a_body_home_from_anywhere(cloud):
    true = motion(300, 130)
    moved = transform_points(true, cloud)
    assert min(left_over(m, true, cloud) for m in principal_motions(moved, cloud)) < 1e-6
    for found in principal_motions(moved, cloud):
        assert torch.linalg.det(found[:3, :3]).item() == pytest.approx(1)


def test_merged_points_are_about_as_many_and_keep_to_the_body(body, cloud):
    few = merged(cloud, 200)
    assert 200 <= len(few) < 300
    assert torch.equal(merged(cloud, len(cloud)), cloud)
    assert (few.mean(0) - cloud.mean(0)).norm() < 1.0


def test_the_direction_is_from_moving_to_fixed(cloud):
    points, true = cloud[:200], motion(2, 3)
    found = rigid_coherent_point_drift(points, transform_points(true, points))
    torch.testing.assert_close(found, true, rtol=0, atol=2e-3)
    assert (found - invert_rigid(true)).abs().max() > 1


def test_clouds_without_points_are_refused(body):
    with pytest.raises(ValueError, match="moving must have shape"):
        rigid_coherent_point_drift(torch.zeros(0, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="points must be finite"):
        align_to_surface(torch.full((4, 3), float("nan")), body)

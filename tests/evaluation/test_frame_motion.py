"""Motion of one implant relative to another over frames: against motions that are known."""

from types import SimpleNamespace

import pytest
import torch
import trimesh

from torchkcreg.deformation import Deviations
from torchkcreg.evaluation import frame_motion
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud

STAND = rigid_matrix(torch.tensor([0.3, -0.8, 0.2]).double(), torch.tensor([30.0, -40.0, 5.0]).double())
ELSEWHERE = rigid_matrix(torch.tensor([-0.5, 0.4, 1.1]).double(), torch.tensor([0.0, 12.0, -9.0]).double())
PLACE = rigid_matrix(torch.tensor([0.1, 0.0, -0.2]).double(), torch.tensor([0.0, 0.0, 60.0]).double())
TURN, SHIFT = torch.tensor([2.0, -1.0, 0.5]).double(), torch.tensor([0.4, -0.2, 1.5]).double()


@pytest.fixture(scope="module")
def cloud() -> ImplantPointCloud:
    return ImplantPointCloud.from_mesh(trimesh.creation.box((12.0, 8.0, 40.0)), 2.0, dtype=torch.float64)


def registered(cloud, pose, fields=None):
    known = None if fields is None else Deviations(cloud.points, fields, torch.tensor([0.0, 1.0, 0.0]).double())
    return SimpleNamespace(warp=lambda points: transform_points(pose, points), deviations=known)


def moved(cloud):
    """The place in the reference, turned about the implant's centre and shifted, in the reference's axes."""
    centre = transform_points(PLACE, cloud.points.mean(0)[None])[0]
    about = rigid_matrix(torch.deg2rad(TURN), torch.zeros(3).double())
    there = rigid_matrix(torch.zeros(3).double(), centre + SHIFT)
    return there @ about @ rigid_matrix(torch.zeros(3).double(), -centre) @ PLACE


def test_the_motion_is_that_in_the_reference_wherever_both_stand(cloud) -> None:
    still = torch.zeros(1, len(cloud.points), 3).double()
    moving = [registered(cloud, STAND @ PLACE, still), registered(cloud, ELSEWHERE @ moved(cloud), still)]
    reference = [registered(cloud, STAND, still), registered(cloud, ELSEWHERE, still)]
    motion = frame_motion(moving, cloud, reference, cloud)
    torch.testing.assert_close(motion.values[0], torch.zeros(6).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(motion.values[1], torch.cat([TURN, SHIFT]), atol=1e-9, rtol=0)
    torch.testing.assert_close(motion.std, torch.zeros(2, 6).double(), atol=1e-9, rtol=0)
    assert float(motion.angles_deg[1]) == pytest.approx(float(TURN.norm()))


def test_without_a_reference_it_is_the_motion_in_the_world(cloud) -> None:
    motion = frame_motion([registered(cloud, PLACE), registered(cloud, moved(cloud))], cloud)
    torch.testing.assert_close(motion.values[1], torch.cat([TURN, SHIFT]), atol=1e-9, rtol=0)
    assert bool(motion.std.isnan().all())  # no expected errors, no bars


def test_errors_of_both_frames_and_both_implants_add_in_squares(cloud) -> None:
    along = torch.zeros(1, len(cloud.points), 3).double()
    along[..., 0] = 0.1  # shifts every implant along x of the world
    pose = torch.eye(4).double()
    motion = frame_motion([registered(cloud, pose, along)] * 2, cloud, [registered(cloud, pose, along)] * 2, cloud)
    assert motion.std[1].tolist() == pytest.approx([0, 0, 0, 0.2, 0, 0], abs=1e-9)
    alone = frame_motion([registered(cloud, pose, along)] * 2, cloud)
    assert alone.std[1].tolist() == pytest.approx([0, 0, 0, 0.1 * 2**0.5, 0, 0], abs=1e-9)


def test_a_frame_without_registration_leaves_a_gap(cloud) -> None:
    motion = frame_motion([None, registered(cloud, PLACE), registered(cloud, moved(cloud))], cloud)
    assert bool(motion.values[0].isnan().all()) and bool(motion.poses[0].isnan().all())
    torch.testing.assert_close(motion.values[1], torch.zeros(6).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(motion.values[2], torch.cat([TURN, SHIFT]), atol=1e-9, rtol=0)


def test_no_frame_or_half_a_reference_is_refused(cloud) -> None:
    with pytest.raises(ValueError, match="no frame has a registration"):
        frame_motion([None, None], cloud)
    with pytest.raises(ValueError, match="a reference implant needs its nodes"):
        frame_motion([registered(cloud, PLACE)], cloud, [registered(cloud, STAND)])

"""Fragments of a fracture and how one moves against the other: against motions that are known."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
import trimesh

from torchkcreg.deformation import Deviations
from torchkcreg.evaluation import fracture_plane, fragments_of, frame_changes, relative_motion
from torchkcreg.geometry import invert_rigid, rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud, Screw

POSE = rigid_matrix(torch.tensor([0.02, -0.01, 0.03]).double(), torch.tensor([3.0, -40.0, 5.0]).double())
CAD = rigid_matrix(torch.tensor([0.7, -1.1, 0.4]).double(), torch.tensor([30.0, 12.0, -80.0]).double())
TURN = torch.deg2rad(torch.tensor([1.5, 0.2, -0.4]).double())  # across, out of plane, along
SHIFT = torch.tensor([0.1, -0.3, 0.05]).double()
DEPTH = torch.tensor([0.0, 1.0, 0.0]).double()
SCREWS = [Screw((0, 2, z), (0, -30, z), 2.0, name=f"s{n}") for n, z in enumerate((-50.0, -30.0, 20.0, 50.0))]


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    return trimesh.creation.box((12.0, 4.0, 130.0))


@pytest.fixture(scope="module")
def cloud(mesh) -> ImplantPointCloud:
    return ImplantPointCloud.from_mesh(mesh, 1.0, dtype=torch.float64)


def registered(cloud, motion=None, *, frame=None, fields=None):
    """An implant at a pose; the part above -5 mm moved by a motion in the implant's frame; seen from a CAD frame."""
    frame = torch.eye(4).double() if frame is None else frame
    motion = torch.eye(4).double() if motion is None else motion

    def warp(points):
        local = transform_points(invert_rigid(frame), points)
        return transform_points(POSE, torch.where(local[:, 2:] > -5, transform_points(motion, local), local))

    fields = torch.zeros(1, len(cloud.points), 3).double() if fields is None else fields
    nodes = transform_points(frame, cloud.points)
    screws = [screw.moved_by(frame) for screw in SCREWS]
    return SimpleNamespace(warp=warp, screws=screws, deviations=Deviations(nodes, fields, DEPTH))


def about_the_gap(gap: torch.Tensor) -> torch.Tensor:
    """The upper part's motion: turned about the gap, then shifted."""
    # across is out of plane (y) x along (z): x
    return (
        rigid_matrix(torch.zeros(3).double(), gap + SHIFT)
        @ rigid_matrix(TURN, torch.zeros(3).double())
        @ rigid_matrix(torch.zeros(3).double(), -gap)
    )


def test_a_known_motion_is_found_whatever_the_frame(cloud, mesh) -> None:
    fragments = fragments_of(cloud.points, SCREWS)
    assert fragments.names == (("s0", "s1"), ("s2", "s3"))
    assert fragments.gap.tolist() == pytest.approx([0.0, 0.0, -5.0], abs=0.3)
    motion = about_the_gap(fragments.gap)
    found = relative_motion(registered(cloud), registered(cloud, motion), cloud, fragments)
    torch.testing.assert_close(found.rotation_deg, torch.rad2deg(TURN), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.translation_mm, SHIFT, atol=1e-6, rtol=0)
    assert float(found.deflection_mm[0].norm()) < 1e-6
    tip = cloud.points[cloud.points[:, 2] > 60]
    expected = (transform_points(motion, tip) - tip).mean(0)
    torch.testing.assert_close(found.deflection_mm[-1], expected, atol=0.1, rtol=0)
    second = registered(cloud, motion, frame=CAD)
    again = relative_motion(registered(cloud), second, cloud, fragments, to_second=CAD)
    torch.testing.assert_close(again.rotation_deg, found.rotation_deg, atol=1e-6, rtol=0)
    swapped = relative_motion(registered(cloud), registered(cloud, motion), cloud, fragments.swapped())
    torch.testing.assert_close(swapped.translation_mm, found.translation_mm, atol=1e-6, rtol=0)


def test_deviations_are_those_of_what_moves_against_each_other(cloud) -> None:
    fragments = fragments_of(cloud.points, SCREWS)
    arms = cloud.points - fragments.gap
    turned = torch.linalg.cross(torch.tensor([1e-3, 0, 0]).double().expand_as(arms), arms)
    alone = torch.where(arms[:, 2:] > 0, turned, torch.zeros_like(turned))
    whole = turned + torch.tensor([0.0, 0.4, 0.0]).double()
    world = torch.stack([alone, whole]) @ POSE[:3, :3].T
    first = registered(cloud)
    only_whole = relative_motion(first, registered(cloud, fields=world[1:]), cloud, fragments)
    assert float(only_whole.rotation_std_deg.max()) < 1e-4
    found = relative_motion(first, registered(cloud, fields=world), cloud, fragments)
    assert float(found.rotation_std_deg[0]) == pytest.approx(0.0573, rel=0.01)
    both = relative_motion(registered(cloud, fields=world), registered(cloud, fields=world), cloud, fragments)
    assert float(both.rotation_std_deg[0]) == pytest.approx(0.0573 * 2**0.5, rel=0.01)
    first.deviations = None
    assert bool(relative_motion(first, first, cloud, fragments).rotation_std_deg.isnan().all())


def test_fragments_are_told_by_a_plane_a_mesh_or_the_ends(cloud) -> None:
    at = torch.tensor([0.0, 0.0, 30.0]).double()
    assert fragments_of(cloud.points, SCREWS, plane=(at, None)).names == (("s0", "s1", "s2"), ("s3",))
    bone = trimesh.creation.cylinder(10.0, 60.0, transform=trimesh.transformations.translation_matrix((0, -20, -45)))
    told = fragments_of(cloud.points, SCREWS, mesh=bone)
    assert told.names == (("s2", "s3"), ("s0", "s1"))
    ends = fragments_of(cloud.points, [])
    assert float(ends.lower[:, 2].max()) < -20 and float(ends.upper[:, 2].min()) > 20
    with pytest.raises(ValueError, match="one fragment"):
        fragments_of(cloud.points, SCREWS, plane=(torch.tensor([0.0, 0, 90]).double(), None))
    with pytest.raises(ValueError, match="screws"):
        fragments_of(cloud.points, [], mesh=bone)


def test_frames_of_one_implant_are_found_and_another_implant_is_refused(mesh) -> None:
    moved = mesh.copy()
    moved.apply_transform(CAD.numpy())
    (change,) = frame_changes(mesh, moved)
    torch.testing.assert_close(change, CAD, atol=1e-6, rtol=0)
    finer = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(moved.vertices, moved.faces, 8.0), process=True)
    changes = frame_changes(mesh, finer)
    assert len(changes) == 4  # a bar is laid onto itself in four ways
    assert min(float((change - CAD).abs().max()) for change in changes) < 0.05
    with pytest.raises(ValueError, match="not of the same implant"):
        frame_changes(mesh, trimesh.creation.box((12.0, 4.0, 120.0)))


def test_the_fracture_is_where_the_screws_turn_against_each_other_not_where_they_are_furthest_apart(cloud) -> None:
    # screws at -50, -30, 20, 50: the widest gap is from -30 to 20, and the implant bends at 35
    def bent(points):
        turned = rigid_matrix(torch.tensor([0.04, 0.0, 0.0]).double(), torch.tensor([0.0, 0.0, 0.0]).double())
        shifted = points - torch.tensor([0.0, 0.0, 35.0]).double()
        return torch.where(points[:, 2:] > 35, transform_points(turned, shifted), shifted)

    straight = SimpleNamespace(warp=lambda points: points.double(), screws=SCREWS, follow_radius_mm=8.0)
    loaded = SimpleNamespace(warp=bent, screws=SCREWS, follow_radius_mm=8.0)
    plane = fracture_plane(straight, [(loaded, None)], cloud.points)
    assert abs(float(plane[0][2])) == pytest.approx(35.0, abs=0.1)
    parts = fragments_of(cloud.points, SCREWS, plane=plane)
    assert sorted(map(len, parts.names)) == [1, 3]
    # a straight implant does not tell: the widest gap
    still = fracture_plane(straight, [(straight, None)], cloud.points)
    assert float(still[0][2]) == pytest.approx(-5.0, abs=0.1)
    assert fracture_plane(straight, [], cloud.points) is None

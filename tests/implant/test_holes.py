"""Round holes in meshes: where they are, how wide; combination holes, seams, and implants that have none."""

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.implant import find_holes
from torchkcreg.simulation.hardware import hole_positions, locking_plate
from torchkcreg.simulation.loads import RodMotion


def test_the_holes_of_a_locking_plate_are_found_in_their_order() -> None:
    holes = find_holes(locking_plate())
    along = np.array([hole.center[2] for hole in holes])
    expected = np.array([float(z) for z in hole_positions()])
    assert np.allclose(np.sort(along), expected, atol=0.01)
    assert (np.diff(along) > 0).all() or (np.diff(along) < 0).all()
    assert all(abs(hole.axis[1]) > 0.999 and hole.depth == pytest.approx(4.6, abs=0.01) for hole in holes)
    assert np.ptp([hole.radius for hole in holes]) < 1e-6


def test_the_axis_of_a_countersunk_hole_goes_from_surface_to_surface() -> None:
    rings = [(2.5, 0.0), (9.0, 0.0), (9.0, 5.0), (3.6, 5.0), (2.5, 3.8), (2.5, 0.0)]
    plate = trimesh.creation.revolve(np.array(rings), sections=48)
    (hole,) = find_holes(plate)
    assert hole.radius == pytest.approx(2.5, abs=0.02)
    assert hole.depth == pytest.approx(5.0) and hole.center[2] == pytest.approx(2.5)


def test_a_hole_turns_and_moves_with_its_mesh() -> None:
    tube = trimesh.creation.annulus(r_min=2.0, r_max=8.0, height=4.0, sections=48)
    motion = trimesh.transformations.euler_matrix(0.3, -0.7, 1.1)
    motion[:3, 3] = (50.0, -20.0, 300.0)
    (hole,) = find_holes(tube.apply_transform(motion))
    assert np.allclose(hole.center, motion[:3, 3], atol=1e-6)
    assert abs(hole.axis @ motion[:3, 2]) == pytest.approx(1.0, abs=1e-9)


def test_a_combination_hole_counts_as_two() -> None:
    half = np.linspace(0.5, 2 * np.pi - 0.5, 40)  # open by 57 degrees towards the other circle
    left = np.column_stack([-2.2 + 2.5 * np.cos(np.pi - half + np.pi), 2.5 * np.sin(np.pi - half + np.pi)])
    inner = np.vstack([left, -left])
    outer = 10.0 * inner / np.linalg.norm(inner, axis=1, keepdims=True)
    holes = find_holes(ring(inner, outer, 4.0))
    assert sorted(round(float(hole.center[0]), 1) for hole in holes) == [-2.2, 2.2]
    assert all(hole.radius == pytest.approx(2.5, abs=0.02) for hole in holes)


def ring(inner: np.ndarray, outer: np.ndarray, height: float) -> trimesh.Trimesh:
    """Closed mesh between two outlines (n, 2) that go round once, point by point."""
    n = len(inner)
    corners = [np.column_stack([o, np.full(n, z)]) for z in (0.0, height) for o in (inner, outer)]
    index = np.arange(n)
    after = np.roll(index, -1)
    low_in, low_out, high_in, high_out = (index + n * k for k in range(4))
    strips = [(low_in, low_out), (low_out, high_out), (high_out, high_in), (high_in, low_in)]
    faces = []
    for one, other in strips:
        faces += [np.column_stack([one, other, other[after]]), np.column_stack([one, other[after], one[after]])]
    mesh = trimesh.Trimesh(np.vstack(corners), np.vstack(faces), process=True)
    mesh.fix_normals()
    assert mesh.is_watertight
    return mesh


def test_solids_pins_and_wide_bores_are_no_screw_holes() -> None:
    assert find_holes(trimesh.creation.box((10, 10, 40))) == []
    assert find_holes(trimesh.creation.cylinder(2.0, 30.0)) == []
    assert find_holes(trimesh.creation.annulus(r_min=9.0, r_max=12.0, height=30.0)) == []


@pytest.mark.parametrize(("hole_offset", "expected"), [(0.0, 8), (1.2, 16), (1.8, 16)])
@pytest.mark.parametrize("flare", [0.0, 0.3])
def test_a_bent_and_twisted_plate_has_as_many_holes_as_a_straight_one(
    hole_offset: float, expected: int, flare: float
) -> None:
    length = 136.0
    plate = locking_plate(length=length, num_holes=8, hole_offset=hole_offset)
    wider = 1 + flare * (plate.vertices[:, 2] / length + 0.5)
    straight = plate.vertices * np.column_stack([wider, np.ones((len(wider), 2))])
    bend = RodMotion(lambda z: torch.tensor([0.09, 0.0, 0.07]).double().expand(len(z), 3) / length, (-70.0, 70.0))
    bent = trimesh.Trimesh(bend(torch.from_numpy(straight)).numpy(), plate.faces, process=False)
    assert len(find_holes(bent)) == expected

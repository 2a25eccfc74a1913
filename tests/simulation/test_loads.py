"""Loads: cross sections stay rigid, the axis keeps its length, the ends turn by the angles asked for."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.geometry import fit_rigid, vector_from_rotation
from torchkcreg.simulation import Load, RodMotion

CROSS = torch.tensor([[7.0, 2.0, 0.0], [-7.0, 2.0, 0.0], [0.0, -30.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)


def section(z: float) -> torch.Tensor:
    return CROSS + torch.tensor([0.0, 0.0, z])


def end_rotation(load: Load, low: float = -60.0, high: float = 60.0) -> list[float]:
    """Rotation vector of the section at `high` against the one at `low`, degrees, in the latter's frame."""
    motion = load.motion()
    first, last = (fit_rigid(section(z), motion(section(z)))[:3, :3] for z in (low, high))
    return torch.rad2deg(vector_from_rotation(first.T @ last)).tolist()


def test_a_constant_curvature_gives_an_arc():
    radius = 200.0
    rate = torch.tensor([1 / radius, 0.0, 0.0], dtype=torch.float64)
    motion = RodMotion(lambda z: rate.expand(len(z), 3), (-50.0, 50.0))
    z = torch.linspace(-50, 50, 7, dtype=torch.float64)
    points = torch.stack([torch.zeros(7), torch.zeros(7), z], dim=1)
    angle = z / radius
    expected = torch.stack([torch.zeros(7), radius * (angle.cos() - 1), radius * angle.sin()], dim=1)
    torch.testing.assert_close(motion(points), expected.double(), rtol=0, atol=1e-9)


def test_beyond_the_bent_stretch_the_motion_is_rigid():
    motion = Load(bend_deg=3.0, lateral_deg=1.0, torsion_deg=2.0).motion()
    points = torch.cat([section(z) for z in (27.0, 60.0, 94.0, 120.0)])
    torch.testing.assert_close(motion(points), points @ (m := fit_rigid(points, motion(points)))[:3, :3].T + m[:3, 3])


def test_the_ends_turn_by_the_angles_asked_for():
    assert end_rotation(Load(bend_deg=3.0)) == pytest.approx([3.0, 0.0, 0.0], abs=1e-6)
    assert end_rotation(Load(lateral_deg=2.0)) == pytest.approx([0.0, 2.0, 0.0], abs=1e-6)
    assert end_rotation(Load(torsion_deg=4.0)) == pytest.approx([0.0, 0.0, 4.0], abs=1e-6)
    assert end_rotation(Load(s_bend_deg=5.0)) == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert end_rotation(Load(s_bend_deg=5.0), high=0.0) == pytest.approx([5.0, 0.0, 0.0], abs=2e-3)


def test_cross_sections_stay_rigid_and_the_axis_keeps_its_length():
    motion = Load(bend_deg=6.0, torsion_deg=5.0, s_bend_deg=4.0, rotation_deg=(1.0, 2.0, 3.0)).motion()
    for z in (-80.0, -13.0, 0.0, 7.3):
        moved = motion(section(z))
        torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(section(z), section(z)))
    axis = torch.zeros(2001, 3, dtype=torch.float64)
    axis[:, 2] = torch.linspace(-94, 94, 2001)
    assert float(motion(axis).diff(dim=0).norm(dim=1).sum()) == pytest.approx(188.0, abs=1e-4)


def test_the_motion_is_continuous_and_smooth():
    motion = Load(bend_deg=6.0, s_bend_deg=4.0).motion()
    step = 0.01
    points = torch.zeros(9001, 3, dtype=torch.float64)
    points[:, 0], points[:, 2] = 5.0, torch.arange(9001, dtype=torch.float64) * step - 45
    tangent = motion(points).diff(dim=0) / step
    largest_rate = math.radians(6.0) / 27 + math.pi * math.radians(4.0) / 54
    assert float(tangent.diff(dim=0).norm(dim=1).max()) < 1.1 * largest_rate * step


def test_on_average_the_plate_moves_by_the_misalignment_alone():
    x, y, z = (torch.linspace(-a, a, n, dtype=torch.float64) for a, n in ((7, 3), (2, 3), (94, 101)))
    plate = torch.cartesian_prod(x, y, z)
    load = Load(
        bend_deg=4.0, s_bend_deg=3.0, torsion_deg=2.0, rotation_deg=(1.0, 0.0, 0.5), translation_mm=(1.0, 2.0, 3.0)
    )
    rigid = fit_rigid(plate, load.motion()(plate))
    assert torch.rad2deg(vector_from_rotation(rigid[:3, :3])).tolist() == pytest.approx([1.0, 0.0, 0.5], abs=0.03)
    assert rigid[:3, 3].tolist() == pytest.approx([1.0, 2.0, 3.0], abs=0.03)


def test_no_load_moves_nothing_and_shapes_and_dtypes_are_kept():
    points = torch.randn(2, 5, 3)
    moved = Load().motion()(points)
    assert moved.dtype == torch.float32
    torch.testing.assert_close(moved, points)


def test_impossible_loads_are_refused():
    with pytest.raises(ValueError, match="zone_mm"):
        Load(zone_mm=100.0)
    with pytest.raises(ValueError, match="stretch"):
        RodMotion(lambda z: torch.zeros(len(z), 3), (1.0, 2.0))

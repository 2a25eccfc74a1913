"""Plates that bend as elastic bodies on their screws: who carries what, and where things go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchkcreg.geometry import fit_rigid, rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import elastic_constants
from torchkcreg.simulation import draw_case, random_case
from torchkcreg.simulation.elastic import Fragments, elastic_motion
from torchkcreg.simulation.population import motions, view_geometry

DRAW = replace(draw_case(1), loose=None)  # titanium, straight holes 0, 1 below and 4, 5, 6 above, of seven


@pytest.fixture(scope="module")
def case():
    geometry = view_geometry(DRAW, "neighbours")
    return random_case(DRAW, elastic=True, counts=torch.zeros(3, *geometry.det_shape))


def moving(case):
    """The plate's motion and what it carries, of two fragments that turn by a degree."""
    held = Fragments([DRAW.hole_heights[hole] for hole in DRAW.holes_used], (1.0, 0.2, 0.5))
    pose, rng = torch.eye(4, dtype=torch.float64), np.random.default_rng(0)
    return elastic_motion(motions(DRAW)[0], case.implant, DRAW.material, held, pose, rng)


def test_only_screws_carry_and_what_they_carry_is_in_balance(case) -> None:
    carried = case.carried
    used = [hold in DRAW.holes_used for hold in range(len(carried.holds))]
    size = carried.hold_loads.abs().amax(0)
    assert float(carried.hold_loads[[not u for u in used]].abs().max()) < 1e-3 * float(size.max())
    assert float(carried.hold_loads[used].norm(dim=1).min()) > 1e-3 * float(size.max())
    assert float(carried.hold_loads[:, :3].sum(0).abs().max()) < 1e-6 * float(size[:3].max())
    ends = torch.stack([carried.section_loads[0], carried.section_loads[-1]])
    assert float(ends.abs().max()) < 1e-6 * float(size.max())


def test_between_the_fragments_moments_change_as_the_shear_force_says(case) -> None:
    carried = case.carried
    low, high = carried.hold_heights[1] + 1, carried.hold_heights[4] - 1  # no screws in holes 2 and 3
    between = (carried.heights > low) & (carried.heights < high)
    shear, moments = carried.section_loads[between, :2], carried.section_loads[between, 3:5]
    slopes = moments.diff(dim=0) / carried.heights[between].diff()[:, None]
    torch.testing.assert_close(slopes[:, 0].abs(), shear[1:, 1].abs(), rtol=5e-3, atol=0.2)
    torch.testing.assert_close(slopes[:, 1].abs(), shear[1:, 0].abs(), rtol=5e-3, atol=0.2)


def test_highest_stresses_are_such_as_the_alloy_bears(case) -> None:
    motion = moving(case)[0]
    element, limit = motion.deformation.superelement, elastic_constants(DRAW.material).yield_stress
    points = torch.as_tensor(case.implant.vertices.copy())
    stress = element.stress(points, motion.deformation.amounts.detach())
    deviator = stress - stress.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(3).double()
    highest = float((1.5 * deviator.square().sum((-2, -1))).sqrt().quantile(0.98))
    assert 0.19 * limit < highest < 0.81 * limit


def test_screws_and_sections_go_with_the_plate(case) -> None:
    motion = moving(case)[0]
    heights = torch.tensor([-30.0, 0.0, 25.0], dtype=torch.float64)
    frames = motion.frames(heights)
    local = torch.tensor([[3.0, 1.0, 0.0], [-3.0, -1.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    for frame, z in zip(frames, heights, strict=True):
        lifted = local + torch.tensor([0.0, 0.0, float(z)], dtype=torch.float64)
        torch.testing.assert_close(transform_points(frame, local), motion(lifted), atol=0.02, rtol=0)
    screw = case.screws[0]
    ends = torch.tensor([screw.start, screw.end], dtype=torch.float64)
    part = next(part.shape for part in case.parts if part.name == "screw0")
    torch.testing.assert_close(torch.stack([part.start, part.end]).double(), case.deform(ends), atol=0.1, rtol=0)


def test_the_plate_moves_by_the_drawn_misalignment_on_average(case) -> None:
    points = ImplantPointCloud.from_mesh(case.implant, 1.0).points.double()
    turn = torch.deg2rad(torch.tensor(DRAW.turn_deg, dtype=torch.float64))
    drawn = rigid_matrix(turn, torch.tensor(DRAW.shift, dtype=torch.float64))
    moved = case.deform(points)
    torch.testing.assert_close(fit_rigid(points, moved), drawn, atol=0.06, rtol=0)
    assert float((moved - transform_points(drawn, points)).norm(dim=1).max()) > 0.3  # and it is bent


def test_a_loose_screw_carries_nothing() -> None:
    draw = replace(DRAW, loose=4)
    carried = random_case(
        draw, elastic=True, counts=torch.zeros(3, *view_geometry(draw, "neighbours").det_shape)
    ).carried
    assert float(carried.hold_loads[6].abs().max()) < 1e-3 * float(carried.hold_loads.abs().max())

"""Random cases: what a seed stands for, and the truth about it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.implant import find_holes
from torchkcreg.simulation import RodMotion, draw_case, locking_plate, random_case
from torchkcreg.simulation.population import random_specimen, view_geometry

_NO_IMAGES = torch.zeros(3, 4, 4, dtype=torch.uint16)


def test_a_seed_names_a_case_and_cases_differ():
    draws = [draw_case(seed) for seed in range(40)]
    assert draw_case(7) == draws[7]
    assert {d.material for d in draws} == {"steel", "titanium"}
    assert {d.scanner for d in draws} == {"extremity", "c-arm"}
    assert any(d.loose is not None for d in draws) and any(d.s_bend_deg for d in draws)
    assert any(d.water_radius == 0 for d in draws) and any(d.tilt_deg for d in draws)
    assert min(d.azimuth_deg for d in draws) < 20 and max(d.azimuth_deg for d in draws) > 160


def test_both_fragments_are_held_by_screws_in_holes_of_the_plate():
    for seed in range(40):
        draw = draw_case(seed)
        held = [h for i, h in enumerate(draw.holes_used) if i != draw.loose]
        heights = [draw.hole_heights[h] for h in held]
        assert min(heights) < 0 < max(heights)
        assert set(draw.holes_used) <= set(range(draw.num_holes))


def test_a_straightened_point_goes_back_to_where_it_was():
    rates = torch.tensor([0.001, 0.0005, 0.0008], dtype=torch.float64)
    motion = RodMotion(lambda z: rates.expand(len(z), 3), (-80.0, 80.0))
    points = torch.tensor([[5.0, -2.0, 60.0], [-12.0, 3.0, -75.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(motion.straightened(motion(points)), points, atol=1e-9, rtol=0)


def test_beads_move_rigidly_with_the_plate_beside_them():
    for seed in (1, 6):
        case = random_case(seed, counts=_NO_IMAGES)
        torch.testing.assert_close(case.deform(case.beads_before), case.beads_after, atol=0.1, rtol=0)
        for group in (slice(0, 4), slice(4, 8)):
            motion = fit_rigid(case.beads_before[group], case.beads_after[group])
            moved = case.beads_before[group] @ motion[:3, :3].T + motion[:3, 3]
            torch.testing.assert_close(moved, case.beads_after[group], atol=1e-6, rtol=0)


def test_the_implant_is_closed_and_lies_in_every_view():
    for seed in range(8):
        draw = draw_case(seed)
        case = random_case(draw, counts=_NO_IMAGES)
        assert case.implant.is_watertight
        geometry = view_geometry(draw, "both")
        assert geometry.num_views == 9
        uv, depth = geometry.project(torch.tensor(case.implant.vertices))
        rows, cols = geometry.det_shape
        inside = (uv >= 0).all(-1) & (uv[..., 0] < cols) & (uv[..., 1] < rows)
        assert (depth > 0).all() and (inside.float().mean(-1) > 0.5).all()


def test_a_combination_hole_counts_as_two_round_ones():
    plate = locking_plate(length=72.0, num_holes=4, hole_offset=1.8)
    assert plate.is_watertight
    holes = find_holes(plate)
    assert len(holes) in (4, 8)
    assert locking_plate(length=72.0, num_holes=4).volume > plate.volume


def test_images_show_metal_limb_and_open_beam():
    draw = draw_case(6)
    counts = random_case(draw).intensity.float() / draw.panel.open_beam
    assert counts.shape == (3, 704, 256)
    assert float(counts.min()) < 0.2 and float(counts.max()) > 0.9


def test_every_draw_makes_a_specimen_whose_parts_fit():
    for seed in range(30):
        draw = draw_case(seed)
        phantom = random_specimen(draw)
        assert len(phantom.screws) == len(draw.holes_used)
        assert [phantom.holds(number) for number in range(len(phantom.screws))].count(False) == (draw.loose is not None)
        random_case(draw, counts=_NO_IMAGES)


def test_a_loose_screw_moves_with_the_plate_and_not_with_its_fragment():
    draw = replace(draw_case(6), bend_deg=2.4)
    inner = max(number for number, hole in enumerate(draw.holes_used) if draw.hole_heights[hole] < 0)
    held, freed = (random_case(replace(draw, loose=loose), counts=_NO_IMAGES) for loose in (None, inner))
    tips = [next(part.shape.end for part in case.parts if part.name == f"screw{inner}") for case in (held, freed)]
    assert float((tips[0] - tips[1]).norm()) > 0.05
    fragment = fit_rigid(freed.beads_before[:4], freed.beads_after[:4])
    tip = torch.tensor(freed.screws[inner].end, dtype=torch.float64)
    assert float((transform_points(fragment, tip[None])[0] - tips[1]).norm()) > 0.05


def test_an_elastic_case_is_stressed_below_its_yield_and_its_load_is_in_balance():
    draw = replace(draw_case(1), loose=None)
    case = random_case(draw, elastic=True, counts=_NO_IMAGES)
    carried = case.carried
    size = carried.hold_loads.abs().amax(0)
    assert float(carried.hold_loads[:, :3].sum(0).abs().max()) < 1e-6 * float(size[:3].max())
    idle = [hold for hold in range(len(carried.holds)) if hold not in draw.holes_used]
    assert float(carried.hold_loads[idle].abs().max()) < 1e-3 * float(size.max())
    moved = case.deform(case.beads_before)
    torch.testing.assert_close(moved, case.beads_after, atol=0.05, rtol=0)


def test_a_loose_screw_of_an_elastic_case_carries_nothing():
    draw = replace(draw_case(1), loose=4)
    carried = random_case(draw, elastic=True, counts=_NO_IMAGES).carried
    loose = int((carried.hold_heights - carried.hold_heights.sort().values[draw.holes_used[4]]).abs().argmin())
    assert float(carried.hold_loads[loose].abs().max()) < 1e-3 * float(carried.hold_loads.abs().max())


def test_a_loose_screw_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"numbers of the \d screws, got \(9,\)"):
        random_specimen(replace(draw_case(1), loose=9))

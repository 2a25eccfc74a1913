"""Random cases: what a seed stands for, and the truth about it."""

from __future__ import annotations

import torch

from torchkcreg.geometry import fit_rigid
from torchkcreg.implant import find_holes
from torchkcreg.simulation import draw_case, locking_plate, random_case
from torchkcreg.simulation.population import motions, view_geometry

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
    rest, loaded = motions(draw_case(4))
    points = torch.tensor([[5.0, -2.0, 60.0], [-12.0, 3.0, -75.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    for motion in (rest, loaded):
        torch.testing.assert_close(motion.straightened(motion(points)), points, atol=1e-9, rtol=0)


def test_beads_move_rigidly_with_the_plate_beside_them():
    for seed in (1, 6):
        case = random_case(seed, counts=_NO_IMAGES)
        torch.testing.assert_close(case.deform(case.beads_before), case.beads_after, atol=1e-6, rtol=0)
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
    counts = random_case(draw).intensity.float() / draw.detector.open_beam
    assert counts.shape == (3, 704, 256)
    assert float(counts.min()) < 0.08 and float(counts.max()) > 0.9

from __future__ import annotations

from collections import Counter

import pytest
import torch

from torchkcreg.geometry import MultisourceScanner


def test_two_hundred_views_fire_fifty_hundred_fifty() -> None:
    geometry = MultisourceScanner().geometry()
    assert geometry.num_views == 200
    assert Counter(geometry.sources) == {"T1": 50, "T2": 100, "T3": 50}
    assert geometry.angles_deg == tuple(float(angle) for angle in range(200))


def test_t1_fires_at_91_degrees_and_the_sources_follow_in_turn() -> None:
    scanner = MultisourceScanner()
    assert scanner.view_sources()[91:99] == ["T1", "T2", "T3", "T2", "T1", "T2", "T3", "T2"]
    assert scanner.paper_views("3") == [91, 92, 93]


def test_each_view_has_its_source_at_its_height() -> None:
    scanner = MultisourceScanner()
    geometry = scanner.geometry()
    heights = torch.tensor([scanner.source_z_mm[source] for source in geometry.sources], dtype=torch.float64)
    positions = geometry.source_positions
    torch.testing.assert_close(positions[:, 2], heights, rtol=0, atol=1e-9)
    torch.testing.assert_close(positions[:, :2].norm(dim=-1), torch.full((200,), 404.0, dtype=torch.float64))
    torch.testing.assert_close(geometry.detector_distances, torch.full((200,), 538.0, dtype=torch.float64))


def test_the_detector_is_the_panel_of_768_pixels_of_0_388_mm() -> None:
    geometry = MultisourceScanner().geometry()
    assert geometry.det_shape == (768, 768)
    assert geometry.pixel_spacing == pytest.approx((0.388, 0.388), rel=1e-12)
    half = MultisourceScanner(det_shape=(384, 384)).geometry()
    torch.testing.assert_close(half.projection_matrices, geometry.bin(2).projection_matrices)


def test_the_twelve_views_have_four_of_each_source_near_fifteen_degree_steps() -> None:
    scanner = MultisourceScanner()
    views = scanner.paper_views("12")
    chosen = scanner.geometry().select(views)
    assert Counter(chosen.sources) == {"T1": 4, "T2": 4, "T3": 4}
    for angle, asked in zip(chosen.angles_deg, range(15, 181, 15)):
        assert abs(angle - asked) <= 2
    plain = scanner.geometry().nearest_views(range(15, 181, 15))
    assert Counter(scanner.geometry().select(plain).sources) == {"T1": 3, "T2": 6, "T3": 3}


def test_a_single_source_scanner_is_one_too() -> None:
    scanner = MultisourceScanner(
        source_z_mm={"S": 0.0}, firing_order=("S",), num_views=36, step_deg=10.0, phase_deg=0.0
    )
    assert scanner.geometry().sources == ("S",) * 36


def test_scanners_that_cannot_be_are_refused() -> None:
    for options in (
        {"firing_order": ("T1", "T4")},
        {"firing_order": ()},
        {"num_views": 0},
        {"step_deg": 0.0},
        {"step_deg": 2.0},
        {"sad": 600.0},
    ):
        with pytest.raises(ValueError):
            MultisourceScanner(**options).geometry()
    with pytest.raises(ValueError, match='"12" or "3"'):
        MultisourceScanner().paper_views("4")

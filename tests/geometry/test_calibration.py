import math

import pytest
import torch

from torchkcreg.geometry import ConeBeamGeometry, calibrate, circular_geometry
from torchkcreg.geometry.circular import matrices_from_frames

ANGLES = range(0, 360, 6)
SIZE = {"sad": 404, "sdd": 538, "det_shape": (200, 240), "pixel_spacing": (0.8, 0.8)}
TOLD = circular_geometry(ANGLES, **SIZE)
BEADS = torch.tensor(
    [[20.0, 5.0, -30.0], [-25.0, 8.0, 25.0], [4.0, -30.0, 5.0], [-12.0, -14.0, 40.0]], dtype=torch.float64
)


def moved(shift=(0.0, 0.0, 0.0), turn_normal_deg=0.0) -> ConeBeamGeometry:
    """The same scan with its detector elsewhere: shifts along u, v and away from the source in mm."""
    angles = torch.tensor(list(ANGLES)).double().deg2rad()
    radial = torch.stack([angles.cos(), angles.sin(), 0 * angles], -1)
    across = torch.stack([-angles.sin(), angles.cos(), 0 * angles], -1)
    up = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(radial)
    turn = math.radians(turn_normal_deg)
    away = torch.linalg.cross(across, up) * -1
    away = away * (away * -radial).sum(-1, keepdim=True).sign()
    centers = -134 * radial + shift[0] * across + shift[1] * up + shift[2] * away
    # right-handed about the normal that points away from the source, -radial
    cols = math.cos(turn) * across + math.sin(turn) * torch.linalg.cross(-radial, across)
    rows = math.cos(turn) * up + math.sin(turn) * torch.linalg.cross(-radial, up)
    matrices = matrices_from_frames(404 * radial, centers, cols, rows, det_shape=(200, 240), pixel_spacing=(0.8, 0.8))
    return ConeBeamGeometry(matrices, (200, 240), (0.8, 0.8))


def tracks(geometry, beads=BEADS, noise=0.0):
    uv = geometry.project(beads)[0]
    return uv + noise * torch.randn(uv.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_a_detector_that_stands_elsewhere_is_found():
    truth = moved((3.0, -5.0, 12.0), 1.5)
    found = calibrate(TOLD, tracks(truth))
    told = [found.detector[name] for name in ("shift_u_mm", "shift_v_mm", "shift_depth_mm", "turn_normal_deg")]
    assert told == pytest.approx([3.0, -5.0, 12.0, 1.5], abs=0.05)
    assert found.median_px < 0.01 < 1 < found.before_px
    assert torch.allclose(found.beads, BEADS, atol=0.05)
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 80 - 40
    assert (found.geometry.project(points)[0] - truth.project(points)[0]).norm(dim=-1).max() < 0.05


def test_the_deviations_cover_the_errors_that_noise_makes():
    found = calibrate(TOLD, tracks(moved((3.0, -5.0, 0.0), 1.0), noise=0.3))
    errors = {"shift_u_mm": 3.0, "turn_normal_deg": 1.0}
    for name, truth in errors.items():
        assert abs(found.detector[name] - truth) < 3.5 * found.deviations[name]
        assert found.deviations[name] < 0.1
    assert found.median_px == pytest.approx(0.3 * 1.18, rel=0.15)


def test_shadows_that_were_missed_or_mistaken_do_little():
    seen = tracks(moved((3.0, -5.0, 0.0)), noise=0.1)
    seen[5:15, 0] = math.nan
    seen[::10, 1] += 8.0
    found = calibrate(TOLD, seen)
    assert found.detector["shift_u_mm"] == pytest.approx(3.0, abs=0.15)
    assert found.residuals[7, 0].isnan().all() and found.residuals[10, 1].norm() > 8


def test_angles_counted_in_the_wrong_sense_are_told():
    nonsense = torch.rand(60, 2, 2, generator=torch.Generator().manual_seed(0)) * 200
    with pytest.raises(ValueError, match="the direction of rotation"):
        calibrate(TOLD, nonsense)
    backwards = calibrate(circular_geometry([-a for a in ANGLES], **SIZE), tracks(TOLD))
    assert backwards.median_px > 20 * calibrate(TOLD, tracks(TOLD)).median_px


def test_wrong_tracks_are_refused():
    with pytest.raises(ValueError, match=r"tracks must have shape \(60, N, 2\)"):
        calibrate(TOLD, torch.zeros(10, 2, 2))
    few = tracks(TOLD)
    few[2:, 0] = math.nan
    with pytest.raises(ValueError, match="three views or more"):
        calibrate(TOLD, few)

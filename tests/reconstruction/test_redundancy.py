"""Weights of lines measured once or twice, for any angles and any detector."""

import math
import warnings

import pytest
import torch

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import fdk
from torchkcreg.reconstruction.redundancy import LineCoverage, angular_sampling

TURN = list(range(0, 360, 2))
RANDOM = (torch.rand(300, generator=torch.Generator().manual_seed(0)) * 360).tolist()


def fans(num_views: int, low: float, high: float, cols: int = 41) -> torch.Tensor:
    """Fan angles (V, cols) of columns whose outer edges are at `low` and `high` degrees."""
    half = (high - low) / cols / 2
    return torch.linspace(low + half, high - half, cols, dtype=torch.float64).deg2rad().expand(num_views, cols)


@pytest.mark.parametrize(
    ("degrees", "low", "high"),
    [
        (range(200), -9.0, 9.0),
        (range(240), -9.0, 9.0),
        (range(300), -9.0, 9.0),
        ([d for d in range(360) if not 40 < d < 70], -9.0, 9.0),
        (range(360), -3.0, 12.0),
        (range(360), -8.0, 9.0),
        ([*range(0, 150), *range(170, 250), *range(270, 360)], -7.0, 7.0),
    ],
)
def test_all_lines_count_once(degrees, low, high):
    angles = torch.tensor([float(d) for d in degrees]).deg2rad()
    sampling, seen = angular_sampling(angles), fans(len(angles), low, high)
    lines = LineCoverage(sampling, seen)
    weights = lines.weights()
    assert lines.unmeasured(1.0)[0] < 0.003
    assert weights.min() >= 0 and weights.max() < 1.02
    alone = -seen[0] < math.radians(low) if high > -low else -seen[0] > math.radians(high)
    if degrees == range(360):  # lines that only one side of the detector sees
        assert torch.allclose(weights[:, alone], torch.ones(()).double(), atol=0.005)
    total = (sampling.steps[:, None] * (weights + weights.flip(1))).sum(0) / (2 * math.pi)
    if low == -high:
        assert torch.allclose(total, torch.ones(()).double(), atol=0.005)


@pytest.mark.parametrize("degrees", [240.0, 200.0, 360.0])
def test_the_two_rays_of_a_line_share_its_weight_exactly(degrees):
    angles = torch.arange(0.0, degrees, 0.5, dtype=torch.float64).deg2rad()
    fan = torch.arange(-9.75, 10.0, 0.25, dtype=torch.float64).deg2rad().expand(len(angles), 79)
    shares = LineCoverage(angular_sampling(angles), fan).shares(fan)
    opposite = (angles[:, None] + math.pi - 2 * fan) % (2 * math.pi)  # at the angle of a view, if there is one
    twin = (opposite.rad2deg() / 0.5).round().long() % 720
    twice = twin < len(angles)
    again = shares.flip(1).gather(0, twin.clamp(max=len(angles) - 1))
    torch.testing.assert_close((shares + again)[twice], torch.ones(int(twice.sum()), dtype=torch.float64))
    alone = ~twice & (twin > len(angles) + 1) & (twin < 718)  # not even half a step beyond the arc's ends
    torch.testing.assert_close(shares[alone], torch.ones(int(alone.sum()), dtype=torch.float64))
    assert shares.min() >= 0 and shares.max() <= 1


def test_a_full_turn_of_a_centred_detector_counts_everything_half():
    weights = LineCoverage(angular_sampling(torch.arange(0.0, 360.0).deg2rad()), fans(360, -9.0, 9.0)).weights()
    assert torch.allclose(weights, torch.full_like(weights, 0.5))


def test_an_offset_detector_counts_its_overlap_smoothly_from_zero_to_one():
    weights = LineCoverage(angular_sampling(torch.arange(0.0, 360.0).deg2rad()), fans(360, -3.0, 12.0, 150)).weights()[
        0
    ]
    assert weights[0] < 1e-3 and weights[60:] == pytest.approx(1.0, abs=1e-3)
    assert (weights[:60] + weights[:60].flip(0)) == pytest.approx(1.0, abs=2e-3)
    overlap = (torch.arange(60) + 0.5) / 60 * 2 - 1
    wang = 0.5 + 0.5 * torch.sin(math.pi / 2 * overlap)
    assert weights[:60].tolist() == pytest.approx(wang.tolist(), abs=2e-3)


def test_steps_of_shuffled_irregular_views_cover_the_turn():
    angles = torch.tensor([0.0, 10, 30, 50, 90, 100, 140, 170, 200, 230, 260, 290, 320, 340]).deg2rad()
    order = torch.randperm(14, generator=torch.Generator().manual_seed(1))
    sampling = angular_sampling(angles[order])
    assert sampling.full
    assert float(sampling.steps.sum()) == pytest.approx(2 * math.pi)
    assert math.degrees(sampling.steps[order.argsort()][1]) == pytest.approx(15.0)


def test_a_short_scan_across_zero_begins_after_its_gap():
    sampling = angular_sampling((torch.arange(250.0, 250.0 + 200.0, 2.0) % 360).deg2rad())
    assert not sampling.full and sampling.covered_deg == pytest.approx(200.0, abs=1e-4)
    assert sampling.arcs.rad2deg().tolist() == [pytest.approx([249.0, 200.0], abs=1e-3)]


def test_two_gaps_leave_two_arcs():
    sampling = angular_sampling(torch.tensor([*range(20, 130), *range(200, 350)]).deg2rad())
    assert sampling.arcs.rad2deg().tolist() == [
        pytest.approx([19.5, 110.0], abs=1e-3),
        pytest.approx([199.5, 150.0], abs=1e-3),
    ]
    across = angular_sampling((torch.tensor([*range(20, 130), *range(200, 350)]) + 30).deg2rad())
    assert sorted(across.arcs.rad2deg().tolist())[1] == pytest.approx([229.5, 150.0], abs=1e-3)


def test_fewer_than_three_views_are_refused():
    with pytest.raises(ValueError, match="at least 3 views"):
        angular_sampling(torch.tensor([0.0, 1.0]))


def disc(angles, offset_mm: float, cols: int = 100) -> torch.Tensor:
    """FDK (61, 61) of a ball of 0.02/mm and radius 60 mm in its middle plane, voxels of 2 mm."""
    geometry = circular_geometry(
        angles, sad=400, sdd=550, det_shape=(7, cols), pixel_spacing=(2.0, 2.0), det_offset_mm=(0.0, offset_mm)
    )
    sources, rays = geometry.source_positions.double()[:, None, None], geometry.rays().double()
    rays = rays / rays.norm(dim=-1, keepdim=True)
    nearest = (sources * rays).sum(-1)
    half = (60.0**2 - (sources.square().sum(-1) - nearest**2)).clamp_min(0).sqrt()
    return fdk((0.04 * half).float(), geometry, VolumeGrid.centered((3, 61, 61), 2.0))[1]


def inside(image: torch.Tensor, radius: float = 50.0) -> torch.Tensor:
    """Voxels of a slice within a radius of its centre."""
    x = torch.arange(61) * 2.0 - 60
    return image[torch.hypot(x[:, None], x[None]) < radius]


@pytest.mark.parametrize(
    ("angles", "offset_mm"),
    [
        (TURN, 0.0),
        (TURN, 0.5),
        (TURN, 4.0),
        (TURN, 12.0),
        (TURN, -60.0),
        ([a for a in TURN if a != 100], 60.0),
        ([a for a in TURN if not 100 <= a < 120], 0.0),
        (range(220), 0.0),
        (range(300), 5.0),
        ([*range(0, 150), *range(170, 250), *range(270, 360)], 0.0),
    ],
    ids=[
        "centred",
        "half a millimetre off",
        "4 mm off",
        "12 mm off",
        "half fan",
        "half fan, one view lost",
        "ten views lost",
        "short scan",
        "short scan, off",
        "two gaps",
    ],
)
def test_levels_are_right_for_any_angles_and_offsets(angles, offset_mm):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = inside(disc([float(a) for a in angles], offset_mm))
    assert float(values.mean()) == pytest.approx(0.02, rel=0.01)
    assert float((values - 0.02).square().mean().sqrt()) < 0.0006


def test_random_angles_have_the_right_level():
    values = inside(disc(RANDOM, 0.0))
    assert float(values.mean()) == pytest.approx(0.02, rel=0.01)
    assert float(inside(disc(RANDOM, 60.0)).mean()) == pytest.approx(0.02, rel=0.015)


def test_a_few_missing_lines_are_said_and_many_are_refused():
    with pytest.warns(UserWarning, match=r"measures 2\.8 % of the lines at .* cover 350 degrees; expect streaks"):
        values = inside(disc([float(a) for a in TURN[:175]], 60.0))
    assert float(values.mean()) == pytest.approx(0.02, rel=0.02)
    with pytest.raises(ValueError, match=r"38\.9 % of the lines .* cover 220 degrees; FDK needs"):
        disc([float(a) for a in range(220)], 60.0)
    with pytest.warns(UserWarning, match="of the lines"):
        disc([float(a) for a in range(185)], 0.0)
    with pytest.raises(ValueError, match="cover 120 degrees"):
        disc([float(a) for a in range(120)], 0.0)
    with pytest.raises(ValueError, match="of the lines at 0 mm"):  # the central ray misses the detector
        disc([float(a) for a in TURN], 110.0)

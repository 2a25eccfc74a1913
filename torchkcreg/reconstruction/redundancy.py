"""Redundancy of the rays of a circular scan: angular steps, Parker weights, offset detectors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

FULL_SCAN_GAP = 1.5  # a largest gap of more than this many typical steps marks the start and end of a short scan
SHORTEST_SCAN_DEG = 179.0
OFFSET_SHARE = 0.1  # a detector shifted by at least this share of its width counts as offset


@dataclass(frozen=True)
class AngularSampling:
    """Angles and angular steps of the views of one circular scan.

    Attributes:
        angles: (V,) angles from the start of the scan, radians, between 0 and `scan_range`.
        steps: (V,) angular interval that each view covers, radians; they add up to `scan_range`.
        scan_range: Angular range of the scan, half a step beyond its ends, radians.
        full: True for a full turn.
    """

    angles: Tensor
    steps: Tensor
    scan_range: float
    full: bool


def angular_sampling(angles: Tensor) -> AngularSampling:
    """Angular sampling of views at gantry angles (V,) in radians, in any order and over any number of turns.

    The largest gap between neighbours distinguishes a short scan, which starts after that gap, from a full scan, which
    has no conspicuous gap.

    Raises:
        ValueError: If there are fewer than 3 views or they cover less than half a turn.

    >>> sampling = angular_sampling(torch.arange(0.0, 200.0).deg2rad())
    >>> sampling.full, round(math.degrees(sampling.scan_range), 3)
    (False, 200.0)
    """
    num_views = len(angles)
    if num_views < 3:
        raise ValueError(f"a scan needs at least 3 views, got {num_views}")
    turned = angles.double() % (2 * math.pi)
    order = torch.argsort(turned, stable=True)
    ordered = turned[order]
    gaps = torch.cat([ordered[1:] - ordered[:-1], (ordered[:1] + 2 * math.pi - ordered[-1:])])
    widest = int(gaps.argmax())
    inner = torch.cat([gaps[:widest], gaps[widest + 1 :]])
    usual = float(inner[inner > 1e-9].median()) if bool((inner > 1e-9).any()) else float(gaps[widest])
    full = float(gaps[widest]) <= FULL_SCAN_GAP * usual
    order, gaps = order.roll(-widest - 1), gaps.roll(-widest - 1)  # the last gap is now the widest
    if not full:
        gaps[-1] = usual
    before, after = gaps.roll(1), gaps
    steps = torch.empty_like(turned)
    steps[order] = (before + after) / 2
    start = turned[order[0]] - before[0] / 2
    scan_range = float(steps.sum())
    if not full and math.degrees(scan_range) < SHORTEST_SCAN_DEG:
        raise ValueError(f"the views cover {math.degrees(scan_range):.1f} degrees, FDK needs 180 plus the fan angle")
    return AngularSampling((turned - start) % (2 * math.pi), steps, scan_range, full)


def parker_weights(angles: Tensor, fan_angles: Tensor, scan_range: float) -> Tensor:
    """Parker weights (V, cols) of a short scan: each line counts once (Parker 1982).

    The ray at gantry angle b and fan angle g is measured again, backwards, at `b + pi - 2 g` and `-g`. With
    `d = (scan_range - pi) / 2` the weight rises as `sin^2(pi/4 b / (d + g))` while `b < 2 (d + g)`, falls as
    `sin^2(pi/4 (pi + 2 d - b) / (d - g))` where `b > pi + 2 g`, and is 1 between. Outside a fan of +-d,
    rays measured once have weight 1; rays that were never measured are missing and are not compensated.

    Args:
        angles: (V,) angles from the start of the scan, radians.
        fan_angles: (V, cols) or (cols,), radians, positive towards increasing gantry angle.
        scan_range: Angular range of the scan, between pi and 2 pi.

    >>> at_the_start = parker_weights(torch.tensor([0.0, 1.5]), torch.zeros(1), math.pi + 0.2)
    >>> at_the_start.flatten().tolist()
    [0.0, 1.0]
    """
    beyond = (scan_range - math.pi) / 2
    b, g = torch.broadcast_tensors(angles[:, None], fan_angles)
    tiny = 1e-12
    rise = torch.sin(math.pi / 4 * b / (beyond + g).clamp_min(tiny)) ** 2
    fall = torch.sin(math.pi / 4 * (math.pi + 2 * beyond - b) / (beyond - g).clamp_min(tiny)) ** 2
    weights = torch.where(b < 2 * (beyond + g), rise, torch.ones_like(b))
    return torch.where(b > math.pi + 2 * g, fall, weights)


def full_scan_weights(positions: Tensor, radius: float | Tensor) -> Tensor:
    """Weights (..., cols) of a full scan: 0.5 for each of the two measurements of a line.

    With a detector offset by a tenth of its width or more, the lines on one side are measured only once. The weight
    then rises smoothly across the part measured twice, from 0 at the short end to 1 (Wang 2002).

    Args:
        positions: Column positions relative to the central ray, at the axis of rotation, (..., cols), mm.
        radius: Source-to-axis distance, mm.
    """
    if not is_offset(positions):
        return torch.full_like(positions, 0.5)
    low, high = float(positions.min()), float(positions.max())
    overlap = min(-low, high)
    toward_long_side = positions if high > -low else -positions
    share = (toward_long_side / radius).atan() / math.atan(overlap / float(torch.as_tensor(radius).mean()))
    return 0.5 + 0.5 * torch.sin(math.pi / 2 * share.clamp(-1, 1))


def is_offset(positions: Tensor) -> bool:
    """True if columns at these positions (mm) belong to an offset detector that still contains the central ray."""
    low, high = float(positions.min()), float(positions.max())
    return low < 0 < high and abs(low + high) >= OFFSET_SHARE * (high - low)

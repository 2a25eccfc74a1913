"""Redundancy of the rays of a circular scan: angular steps, and one weight for lines measured once or twice.

A ray at gantry angle b and fan angle g is the same line as the ray at `b + pi - 2 g` and `-g`. With a confidence c that
falls to 0 at the ends of an arc of views and at the short side of an offset detector, the weight of a ray is
`c / (c + c')`, where c' is the confidence in its counterpart and 0 if that was not measured. The weights of a line add
up to 1 for any set of angles and any detector. For a full turn of an offset detector they are those of Wang (2002);
for a short scan they replace those of Parker (1982).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_GAP = 2.5  # a gap of more than this many steps (their 90th percentile) ends an arc of views
_TAPER = math.radians(30.0)  # width over which the confidence falls to 0 at the end of an arc
_OFFSETS = 4.0  # at the short side of a detector it falls over this many times the difference of its sides
_FANS = 129


@dataclass(frozen=True)
class AngularSampling:
    """Angles and angular steps of the views of one circular scan.

    Attributes:
        angles: (V,) gantry angles, radians, from 0 to 2 pi.
        steps: (V,) angular interval that each view covers, radians.
        arcs: (A, 2) start and length of each arc without a gap, radians; empty for a full turn.
    """

    angles: Tensor
    steps: Tensor
    arcs: Tensor

    @property
    def full(self) -> bool:
        """True for a full turn without a gap."""
        return len(self.arcs) == 0

    @property
    def covered_deg(self) -> float:
        """Angle that the views cover, degrees."""
        return math.degrees(float(self.steps.sum()))

    def confidence(self, angles: Tensor) -> Tensor:
        """Confidence in views at any angles in radians: 0 in a gap, 1 deep inside an arc; shape of `angles`."""
        if self.full:
            return torch.ones_like(angles)
        arcs = self.arcs.to(angles)
        after = (angles[..., None] - arcs[:, 0]) % (2 * math.pi)
        taper = (arcs[:, 1] / 2).clamp(max=_TAPER)
        inside = torch.minimum(after, arcs[:, 1] - after).clamp_min(0) / taper
        return (torch.sin(math.pi / 2 * inside.clamp(max=1)) ** 2).amax(-1)


def angular_sampling(angles: Tensor) -> AngularSampling:
    """Angular sampling of views at gantry angles (V,) in radians, in any order and over any number of turns.

    A view covers half the way to its neighbours. A gap much wider than the others ends an arc; its last view then
    covers half a usual step of it.

    Raises:
        ValueError: If there are fewer than 3 views.

    >>> sampling = angular_sampling(torch.arange(0.0, 200.0).deg2rad())
    >>> sampling.full, round(sampling.covered_deg, 3)
    (False, 200.0)
    """
    if len(angles) < 3:
        raise ValueError(f"a scan needs at least 3 views, got {len(angles)}")
    turned = angles.double() % (2 * math.pi)
    order = torch.argsort(turned, stable=True)
    after = turned[order].roll(-1) - turned[order]  # from each view to the next
    after[-1] += 2 * math.pi
    apart = after[after > 1e-9]
    widest = _GAP * apart.quantile(0.9, interpolation="lower")
    ends = after > widest
    after[ends] = apart[apart <= widest].median()
    before = after.roll(1)
    steps = torch.empty_like(turned)
    steps[order] = (before + after) / 2
    first = ends.roll(1).nonzero()[:, 0]
    starts = turned[order][first] - before[first] / 2
    last = ends.nonzero()[:, 0]
    stops = turned[order][last] + after[last] / 2
    if len(first) and int(first[0]) > int(last[0]):  # the arc before the first gap began before angle 0
        stops = stops.roll(-1)
    arcs = torch.stack([starts, (stops - starts) % (2 * math.pi)], dim=1)
    return AngularSampling(turned, steps, arcs)


@dataclass(frozen=True)
class Fans:
    """Fan angles that the detector sees in each view.

    Attributes:
        low: (V,) fan angle of the detector's edge on the side of falling gantry angle, radians.
        high: (V,) fan angle of its other edge.
    """

    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, fan_angles: Tensor) -> Fans:
        """Edges of detectors whose columns lie at fan angles (V, cols), radians."""
        half = (fan_angles[:, 1:] - fan_angles[:, :-1]).abs().mean(1) / 2
        return cls(fan_angles.amin(1) - half, fan_angles.amax(1) + half)

    def confidence(self, views: Tensor, fan_angles: Tensor) -> Tensor:
        """Confidence in rays at fan angles of the views with the given numbers: 0 beyond the detector."""
        low, high = self.low[views], self.high[views]
        short, long = torch.minimum(-low, high), torch.maximum(-low, high)
        toward_long = torch.where(high > -low, fan_angles, -fan_angles)
        taper = torch.minimum(2 * short, _OFFSETS * (long - short))
        rise = ((toward_long + short) / taper.clamp_min(1e-12)).clamp(0, 1)
        risen = torch.where(taper > 1e-12, torch.sin(math.pi / 2 * rise) ** 2, torch.ones_like(rise))
        inside = (fan_angles >= low) & (fan_angles <= high)
        return torch.where(inside, risen, torch.zeros_like(risen))


class LineCoverage:
    """How often each line of a scan was measured: weights of its rays, and lines that no ray measures.

    Args:
        sampling: Angles of the views.
        fan_angles: (V, cols), radians, positive towards increasing gantry angle.

    >>> turn = angular_sampling(torch.arange(0.0, 360.0).deg2rad())
    >>> LineCoverage(turn, torch.linspace(-0.2, 0.2, 3).expand(360, 3)).weights()[0].tolist()
    [0.5, 0.5, 0.5]
    """

    def __init__(self, sampling: AngularSampling, fan_angles: Tensor) -> None:
        self.sampling, self.fan_angles, self.fans = sampling, fan_angles, Fans.of(fan_angles)
        widest = float(torch.maximum(-self.fans.low, self.fans.high).median())
        self._grid = torch.linspace(0, widest, _FANS, dtype=torch.float64) * (1 - 1e-9)
        both = [self.shares((side * self._grid).expand(len(fan_angles), _FANS)) for side in (1, -1)]
        self._measured = (sampling.steps[:, None] * (both[0] + both[1])).sum(0) / (2 * math.pi)

    def weights(self) -> Tensor:
        """Weights (V, cols) of the rays: the measurements of a line add up to one line.

        Where some of the lines at a distance from the axis were never measured, the others are weighted up for them, so
        that levels stay right.
        """
        measured = _interpolated(self._measured.clamp_min(1e-3), self._grid, self.fan_angles.abs())
        return self.shares(self.fan_angles) / measured

    def unmeasured(self, widest: float) -> tuple[float, float]:
        """Largest share of the lines at one distance from the axis that no ray measures, and its fan angle in radians.

        Args:
            widest: Lines at larger fan angles do not count: they miss the volume.
        """
        missing = (1 - self._measured)[self._grid <= max(widest, float(self._grid[1]))]
        worst = int(missing.argmax())
        return float(missing[worst]), float(self._grid[worst])

    def shares(self, fan_angles: Tensor) -> Tensor:
        """Share (V, n) in its line of each ray at fan angles (V, n) of the views, 0 beyond the detector."""
        views = torch.arange(len(fan_angles))[:, None].expand(fan_angles.shape)
        angles = self.sampling.angles.to(fan_angles)[:, None]
        here = self.sampling.confidence(angles) * self.fans.confidence(views, fan_angles)
        opposite = (angles + math.pi - 2 * fan_angles) % (2 * math.pi)
        twins = _nearest(self.sampling.angles, opposite)
        there = self.sampling.confidence(opposite) * self.fans.confidence(twins, -fan_angles)
        return here / (here + there).clamp_min(torch.finfo(here.dtype).tiny)


def _nearest(angles: Tensor, asked: Tensor) -> Tensor:
    """Number of the view whose angle (V,), from 0 to 2 pi, is nearest to each asked angle."""
    ordered, order = angles.sort()
    around = torch.cat([ordered[-1:] - 2 * math.pi, ordered, ordered[:1] + 2 * math.pi]).to(asked)
    middles = (around[1:] + around[:-1]) / 2
    return order.roll(1)[torch.searchsorted(middles, asked.contiguous()) % len(order)]


def _interpolated(values: Tensor, grid: Tensor, asked: Tensor) -> Tensor:
    """Linear interpolation of values on a regular grid from 0 on; constant beyond its end."""
    place = (asked / grid[1]).clamp(max=len(grid) - 1)
    below = place.long().clamp(max=len(grid) - 2)
    share = place - below
    return values[below] * (1 - share) + values[below + 1] * share

"""Several focal spots: which views belong together, and how their volumes mix."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid

from .field_of_view import coverage

SPREAD_MM = 10.0  # views without labels whose sources' heights differ by less belong together


def views_by_source(geometry: ConeBeamGeometry) -> list[list[int]]:
    """Indices of the views of each focal spot, from the lowest spot to the highest.

    Spots are told apart by their labels, and only where these stand at different heights.
    """
    if geometry.sources is None:
        return [list(range(geometry.num_views))]
    heights = geometry.source_positions[:, 2]
    groups: dict[str, list[int]] = {}
    for view, source in enumerate(geometry.sources):
        groups.setdefault(source, []).append(view)
    means = {source: float(heights[views].mean()) for source, views in groups.items()}
    if max(means.values()) - min(means.values()) < SPREAD_MM:
        return [list(range(geometry.num_views))]
    return [groups[source] for source in sorted(groups, key=lambda source: means[source])]


def height_shares(parts: list[ConeBeamGeometry], grid: VolumeGrid) -> Tensor:
    """Shares (S, D, H, W) of the focal spots' volumes in the mixture; they add up to one.

    FDK is exact in the plane of the spot, and its error grows faster than the distance from it. So a height has the
    nearest spot's volume, and over the middle half of the way from one spot to the next the one passes smoothly into
    the other. Where a spot's views see a voxel in part its share falls with the fourth power of the part.
    """
    heights = [float(part.source_positions[:, 2].mean()) for part in parts]
    z = grid.points()[..., 2]
    shares = []
    for index, (height, part) in enumerate(zip(heights, parts)):
        share = torch.ones_like(z)
        if index > 0:
            share = share * _passage((z - heights[index - 1]) / (height - heights[index - 1]))
        if index + 1 < len(heights):
            share = share * _passage((heights[index + 1] - z) / (heights[index + 1] - height))
        shares.append((share + 1e-6) * coverage(part, grid) ** 4)
    stacked = torch.stack(shares)
    return stacked / stacked.sum(0).clamp_min(1e-12)


def _passage(way: Tensor) -> Tensor:
    """0 for the first quarter of the way, 1 for the last, smooth between; ``f(1 - x) = 1 - f(x)``."""
    inner = (2 * way - 0.5).clamp(0, 1)
    return inner * inner * (3 - 2 * inner)

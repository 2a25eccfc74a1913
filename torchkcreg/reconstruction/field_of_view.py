"""Which voxels the views see, and the grid that holds them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid

COARSE_MM = 8.0  # coverage is smooth: it is computed on nodes about this far apart
RIM_PX = 8.0  # over which a voxel's coverage falls to nothing at the detector's border
SPREAD_MM = 10.0  # views without labels whose sources' heights differ by less belong together


def coverage(geometry: ConeBeamGeometry, grid: VolumeGrid) -> Tensor:
    """Share of the views (D, H, W), float32, that see each voxel; a view near its border counts in part."""
    steps = [max(1, round(COARSE_MM / d)) for d in reversed(grid.spacing)]
    shape = tuple(max(2 if n > 1 else 1, -(-n // step) + 1) for n, step in zip(grid.shape, steps))
    positions = [torch.linspace(0, n - 1, count, dtype=torch.float64) for n, count in zip(grid.shape, shape)]
    k, j, i = torch.meshgrid(*positions, indexing="ij")
    matrix = grid.voxel_to_world
    points = torch.stack([i, j, k], dim=-1).reshape(-1, 3) @ matrix[:3, :3].mT + matrix[:3, 3]
    uv, depth = geometry.project(points.to(geometry.projection_matrices.device))
    rows, cols = geometry.det_shape
    inward = torch.minimum(uv + 0.5, uv.new_tensor([cols - 0.5, rows - 0.5]) - uv)  # (V, N, 2)
    rim = inward.new_tensor([max(1.0, min(RIM_PX, n / 4)) for n in (cols, rows)])
    inside = ((inward / rim).clamp(0, 1).amin(-1) * (depth > 0)).mean(0)
    coarse = inside.reshape(1, 1, *shape).float()
    return interpolate(coarse, size=tuple(grid.shape), mode="trilinear", align_corners=True)[0, 0]


def field_of_view_grid(geometry: ConeBeamGeometry, spacing: float) -> VolumeGrid:
    """A grid of cubes about the z axis that holds all that any view sees near the axis.

    As wide as the circle around the axis that the widest side of the fan touches, and from the lowest to the highest
    height that a ray has there.

    Args:
        geometry: the views.
        spacing: edge of a voxel, mm.

    Raises:
        ValueError: spacing is not positive.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise ValueError(f"spacing must be a positive length in mm, got {spacing}")
    rows, cols = geometry.det_shape
    rays = geometry.rays()
    sources = geometry.source_positions
    across = torch.linalg.cross(rays, sources[:, None, None].expand_as(rays))[..., 2]  # z component
    radius = float((across.abs() / rays[..., :2].norm(dim=-1)).amax())
    level = rays[..., :2].norm(dim=-1)
    nearest = sources[:, :2].norm(dim=-1)[:, None, None] / level
    heights = sources[:, 2, None, None] + nearest * rays[..., 2]
    middle = heights[:, :, cols // 2]
    low, high = float(middle.min()), float(middle.max())
    side = max(1, math.ceil(2 * radius / spacing))
    depth = max(1, math.ceil((high - low) / spacing)) if rows > 1 else 1
    return VolumeGrid.centered((depth, side, side), spacing, center=(0.0, 0.0, (low + high) / 2))


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

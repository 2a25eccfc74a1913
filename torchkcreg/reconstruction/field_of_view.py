"""Field of view: coverage of voxels by the views, and a grid that contains it."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, transform_points

COARSE_MM = 8.0  # coverage is smooth: it is computed on nodes about this far apart
RIM_PX = 8.0  # width of the border over which coverage falls to zero
MOST_SECTORS, COMPLETE = 36, 0.96  # sectors of directions, and the share of them that must hold a line
SPREAD_MM = 10.0  # focal spots whose mean heights differ by less are treated as one


def coverage(geometry: ConeBeamGeometry, grid: VolumeGrid) -> Tensor:
    """Fraction of the views that see each voxel, (D, H, W), float32; a view near its border counts in part."""
    points = _coarse_points(grid, COARSE_MM)
    uv, depth = geometry.project(points.reshape(-1, 3).to(geometry.projection_matrices.device))
    rows, cols = geometry.det_shape
    inward = torch.minimum(uv + 0.5, uv.new_tensor([cols - 0.5, rows - 0.5]) - uv)  # (V, N, 2)
    rim = inward.new_tensor([max(1.0, min(RIM_PX, n / 4)) for n in (cols, rows)])
    inside = ((inward / rim).clamp(0, 1).amin(-1) * (depth > 0)).mean(0)
    return _interpolated(inside.reshape(points.shape[:3]).float(), grid)


def seen_from_all_sides(geometry: ConeBeamGeometry, grid: VolumeGrid) -> Tensor:
    """True for voxels (D, H, W) that lines of all directions around the z axis pass, half a turn of them.

    A voxel beyond the fan of a full turn is not, nor one that a short scan sees from too few sides; one that a half-fan
    turn sees in half of its views is.
    """
    points = _coarse_points(grid, COARSE_MM / 2).to(geometry.projection_matrices.device)
    flat = points.reshape(-1, 3)
    sectors = max(4, min(MOST_SECTORS, geometry.num_views // 4))
    hit = torch.zeros(len(flat), sectors, dtype=torch.bool, device=flat.device)
    rows, cols = geometry.det_shape
    for view, source in enumerate(geometry.source_positions):  # one at a time: all would take gigabytes
        uv, depth = (values[0] for values in geometry.select([view]).project(flat))
        inside = ((uv >= -0.5) & (uv <= uv.new_tensor([cols - 0.5, rows - 0.5]))).all(-1) & (depth > 0)
        x, y = (flat[:, :2] - source[:2]).unbind(-1)
        sector = (torch.atan2(y, x) % math.pi / math.pi * sectors).long().clamp(max=sectors - 1)
        hit[inside, sector[inside]] = True
    return _interpolated(hit.float().mean(1).reshape(points.shape[:3]), grid) >= COMPLETE


def _coarse_points(grid: VolumeGrid, apart_mm: float) -> Tensor:
    """Nodes (d, h, w, 3) about `apart_mm` apart from the first to the last voxel of a grid, float64, in the world."""
    steps = [max(1, round(apart_mm / d)) for d in reversed(grid.spacing)]
    counts = [max(2 if n > 1 else 1, -(-n // step) + 1) for n, step in zip(grid.shape, steps)]
    positions = [torch.linspace(0, n - 1, count, dtype=torch.float64) for n, count in zip(grid.shape, counts)]
    k, j, i = torch.meshgrid(*positions, indexing="ij")
    return transform_points(grid.voxel_to_world, torch.stack([i, j, k], dim=-1))


def _interpolated(coarse: Tensor, grid: VolumeGrid) -> Tensor:
    """Values (D, H, W) at the voxels from those at the nodes of `_coarse_points`."""
    return interpolate(coarse[None, None], size=tuple(grid.shape), mode="trilinear", align_corners=True)[0, 0]


def field_of_view_grid(geometry: ConeBeamGeometry, spacing: float) -> VolumeGrid:
    """Grid of cubic voxels around the z axis that covers the field of view.

    Its width is the diameter of the circle around the axis that touches the outermost rays of the fan. Its height
    reaches from the lowest to the highest ray of the central column where these pass the axis.

    Args:
        geometry: The views.
        spacing: Voxel edge, mm.

    Raises:
        ValueError: If the spacing is not positive.
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

    Focal spots are distinguished by their labels. If they are all at about the same height, they form one group.
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
    """Blending weights (S, D, H, W) of the focal spots' volumes; they add up to one.

    FDK is exact in the plane of the focal spot, and its error grows faster than linearly with the distance from it.
    Each height therefore uses the nearest spot's volume; over the middle half of the distance between two spots their
    volumes are blended smoothly. The weight also falls with the fourth power of the fraction of the spot's views that
    see the voxel.
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
    """Smooth step from 0 in the first quarter to 1 in the last quarter; `f(1 - x) = 1 - f(x)`."""
    inner = (2 * way - 0.5).clamp(0, 1)
    return inner * inner * (3 - 2 * inner)

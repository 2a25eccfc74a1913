"""Which voxels the views see, and the grid that holds them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid

COARSE_MM = 8.0  # coverage is smooth: it is computed on nodes about this far apart
RIM_PX = 8.0  # over which a voxel's coverage falls to nothing at the detector's border


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

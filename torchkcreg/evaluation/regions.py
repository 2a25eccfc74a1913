"""Regions of interest in reconstructed volumes, and statistics of the values inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import VolumeGrid


@dataclass(frozen=True)
class RegionStatistics:
    """Statistics of a volume's values in a region.

    Attributes:
        num_voxels: Number of voxels.
        mean: Mean value.
        std: Standard deviation of the values.
        mean_error: Mean difference from a reference volume in the same voxels, if one is given.
        std_error: Standard deviation of that difference.
    """

    num_voxels: int
    mean: float
    std: float
    mean_error: float | None = None
    std_error: float | None = None


def cylinder_region(grid: VolumeGrid, start: Sequence[float], end: Sequence[float], radius: float) -> Tensor:
    """True for the voxels (D, H, W) whose centres lie in a cylinder between two points in world mm.

    >>> int(cylinder_region(VolumeGrid.centered((5, 5, 5), 1.0), (0, 0, -1), (0, 0, 1), 1.0).sum())
    15
    """
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius}")
    points = grid.points(dtype=torch.float64)
    first, axis = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    axis = axis - first
    along = ((points - first) @ axis) / (axis @ axis)
    distance = (points - first - along[..., None] * axis).norm(dim=-1)
    return (along >= 0) & (along <= 1) & (distance <= radius)


def region_statistics(volume: Tensor, region: Tensor, *, reference: Tensor | None = None) -> RegionStatistics:
    """Mean and standard deviation of a volume (D, H, W) in a region, and of its difference from a reference.

    Raises:
        ValueError: Shapes differ, or the region holds fewer than two voxels.

    >>> region_statistics(torch.tensor([1.0, 3.0, 9.0]), torch.tensor([True, True, False])).mean
    2.0
    """
    if volume.shape != region.shape or (reference is not None and reference.shape != volume.shape):
        raise ValueError(f"volume, region and reference must have one shape, got {volume.shape} and {region.shape}")
    values = volume[region.bool()].double()
    if len(values) < 2:
        raise ValueError(f"region must hold at least two voxels, got {len(values)}")
    mean, std = float(values.mean()), float(values.std())
    if reference is None:
        return RegionStatistics(len(values), mean, std)
    difference = values - reference[region.bool()].double()
    return RegionStatistics(len(values), mean, std, float(difference.mean()), float(difference.std()))

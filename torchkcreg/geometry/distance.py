"""Distances of voxels from a thing in their grid."""

from __future__ import annotations

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from torchkcreg.geometry.volume_grid import VolumeGrid


def distance_to(filled: Tensor, grid: VolumeGrid) -> Tensor:
    """Distances (D, H, W) in mm of voxel centres from the nearest voxel that is filled; infinite where none is.

    Args:
        filled: (D, H, W), true or above zero where the thing is.
        grid: the voxels.
    """
    if not bool((filled > 0).any()):
        return torch.full(grid.shape, torch.inf)
    distances = distance_transform_edt((filled <= 0).cpu().numpy(), sampling=tuple(reversed(grid.spacing)))
    return torch.from_numpy(distances).float()

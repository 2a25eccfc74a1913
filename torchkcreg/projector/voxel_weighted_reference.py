"""FDK's weighted back-projection in plain torch: the readable definition that every other backend has to match.

Matrices (V, 3, 4) in float64 map voxel indices in x, y, z order to homogeneous pixels, depth in mm.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

VOXELS_AT_ONCE = 1 << 19  # bounds the memory


def backproject_by_voxels(images: Tensor, matrices: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """``sum over views of image(u, v) / depth^2`` at each voxel, (B, D, H, W), from images (B, V, rows, cols).

    Images are interpolated bilinearly and fade to zero over one pixel beyond the outermost pixel centres. Voxels behind
    the source get nothing.
    """
    rows, cols = images.shape[2:]
    volume = images.new_zeros(len(images), shape[0] * shape[1] * shape[2])
    for part, voxels in _parts(shape, matrices):
        for view, matrix in enumerate(matrices):
            for pixel, weight in _neighbours(matrix @ voxels, rows, cols):
                volume[:, part] += images[:, view].flatten(1)[:, pixel] * weight.to(images.dtype)
    return volume.reshape(len(images), *shape)


def spread_over_images(volume: Tensor, matrices: Tensor, rows: int, cols: int) -> Tensor:
    """The adjoint of `backproject_by_voxels`: volume (B, D, H, W) into (B, V, rows, cols)."""
    _, depth, height, width = volume.shape
    shape = (depth, height, width)
    images = volume.new_zeros(len(volume), len(matrices), rows * cols)
    for part, voxels in _parts(shape, matrices):
        values = volume.flatten(1)[:, part]
        for view, matrix in enumerate(matrices):
            for pixel, weight in _neighbours(matrix @ voxels, rows, cols):
                images[:, view].index_add_(1, pixel, values * weight.to(volume.dtype))
    return images.reshape(len(volume), len(matrices), rows, cols)


def _parts(shape: tuple[int, int, int], matrices: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Slices of the flattened volume with the homogeneous indices (4, n) of their voxels."""
    _, height, width = shape
    count = shape[0] * height * width
    for first in range(0, count, VOXELS_AT_ONCE):
        part = slice(first, min(first + VOXELS_AT_ONCE, count))
        index = torch.arange(part.start, part.stop, device=matrices.device)
        plane = index.div(width, rounding_mode="floor")
        z = plane.div(height, rounding_mode="floor")
        yield part, torch.stack([index % width, plane % height, z, torch.ones_like(z)]).to(matrices.dtype)


def _neighbours(homogeneous: Tensor, rows: int, cols: int) -> list[tuple[Tensor, Tensor]]:
    """The four flattened pixels around each homogeneous position (3, n), with bilinear weights over squared depth."""
    depth = homogeneous[2]
    front = depth > 0
    safe = torch.where(front, depth, 1.0)
    weight = torch.where(front, safe**-2, 0.0)
    u, v = homogeneous[0] / safe, homogeneous[1] / safe
    return [
        (row * cols + col, share_u * share_v * weight)
        for col, share_u in _linear(u, cols)
        for row, share_v in _linear(v, rows)
    ]


def _linear(position: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """The two pixels around each position and their weights, 0 beyond the image."""
    position = position.clamp(-2, count + 1)
    below = position.floor()
    pairs = ((below, below + 1 - position), (below + 1, position - below))
    return [(i.clamp(0, count - 1).long(), share * ((i >= 0) & (i < count))) for i, share in pairs]

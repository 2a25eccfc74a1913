"""Voxel projector, its adjoint and weighted back-projection in plain torch: the reference for all other backends.

Positions are voxel indices in x, y, z order. For the projector and its adjoint a view is a matrix `[D | s]` of shape
(3, 4): the source is at `s`, the ray of pixel (u, v) has the direction `d = D (u, v, 1)`, and its point at depth t is
`s + t d`.

Joseph 1982, "An improved algorithm for reprojecting rays through pixel images": a ray is sampled where it crosses the
lattice planes of its major axis (the axis along which its voxel index changes most), by bilinear interpolation in the
plane. Beyond the outermost voxel centres values fade to zero over one voxel, so every voxel counts in full.

The weighted back-projection is voxel-driven: it interpolates the images where voxel centres project to.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

AXIS_BIAS = (1.0, 1.0 - 1e-6, 1.0 - 2e-6)  # so that rounding does not decide the major axis at 45 degrees
SAMPLES_AT_ONCE = 1 << 20  # limits memory; affects at most the last bits of sums
VOXELS_AT_ONCE = 1 << 19  # limits memory


def project_by_planes(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int) -> Tensor:
    """Path integrals (B, V, rows, cols) of a volume (B, D, H, W); rays (V, 3, 4) and spacing (3,) in float64."""
    values, (depth, height, width) = volume.flatten(1), volume.shape[1:]
    images = volume.new_zeros(len(volume), len(rays), rows * cols)
    for view, ray in enumerate(rays):
        for pixels, voxels, weights in _samples(ray, spacing, (depth, height, width), rows, cols):
            sampled = values[:, voxels] * weights.to(volume.dtype)
            images[:, view, pixels] += sampled.sum((1, 2))
    return images.reshape(len(volume), len(rays), rows, cols)


def backproject_by_planes(images: Tensor, rays: Tensor, spacing: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Adjoint of `project_by_planes`: images (B, V, rows, cols) into (B, D, H, W)."""
    rows, cols = images.shape[2:]
    volume = images.new_zeros(len(images), shape[0] * shape[1] * shape[2])
    for view, ray in enumerate(rays):
        for pixels, voxels, weights in _samples(ray, spacing, shape, rows, cols):
            spread = images[:, view].flatten(1)[:, None, None, pixels] * weights.to(images.dtype)
            volume.index_add_(1, voxels.flatten(), spread.flatten(1))
    return volume.reshape(len(images), *shape)


def _samples(
    ray: Tensor, spacing: Tensor, shape: tuple[int, int, int], rows: int, cols: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Samples of a view in parts: pixels (n,), the voxels (planes, 4, n) on their rays, and the voxels' weights.

    Pixels and voxels are indices of flattened arrays; weights are in mm.
    """
    counts, strides = shape[::-1], (1, shape[2], shape[1] * shape[2])
    source, directions = ray[:, 3], pixel_directions(ray, rows, cols)
    biased = directions.abs() * directions.new_tensor(AXIS_BIAS)[:, None]
    lengths = (directions * spacing[:, None]).norm(dim=0)
    major = biased.argmax(0)
    for axis in range(3):
        pixels = (major == axis).nonzero()[:, 0]
        if len(pixels) == 0:
            continue
        direction = directions[:, pixels]
        step = lengths[pixels] / direction[axis].abs()  # mm between two planes
        minor_axes = [minor for minor in range(3) if minor != axis]
        planes_at_once = max(1, SAMPLES_AT_ONCE // (4 * len(pixels)))
        for plane in torch.arange(counts[axis], device=ray.device).split(planes_at_once):
            distance = plane[:, None] - source[axis]
            ahead = distance * direction[axis] > 0  # a ray starts at the source
            voxels, weights = plane[:, None, None] * strides[axis], (step * ahead)[:, None]
            for minor in minor_axes:
                position = source[minor] + distance * (direction[minor] / direction[axis])
                index, share = _neighbours(position, counts[minor])
                voxels = (voxels[:, :, None] + index[:, None] * strides[minor]).flatten(1, 2)
                weights = (weights[:, :, None] * share[:, None]).flatten(1, 2)
            yield pixels, voxels, weights


def pixel_directions(ray: Tensor, rows: int, cols: int) -> Tensor:
    """Vectors (3, rows * cols) from the source to depth 1 along the rays of a view."""
    u = torch.arange(cols, dtype=ray.dtype, device=ray.device)
    v = torch.arange(rows, dtype=ray.dtype, device=ray.device)[:, None]
    return (ray[:, 0, None, None] * u + ray[:, 1, None, None] * v + ray[:, 2, None, None]).flatten(1)


def _neighbours(position: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The two lattice points around each position (planes, n) and their linear weights, both (planes, 2, n).

    Points outside the lattice have weight 0 and a valid index.
    """
    below = position.clamp(-2, count + 1).floor()
    fraction = position - below
    index = torch.stack([below, below + 1], 1)
    share = torch.stack([1 - fraction, fraction], 1)
    inside = (index >= 0) & (index < count)
    return index.clamp(0, count - 1).long(), share * inside


def backproject_by_voxels(images: Tensor, matrices: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Weighted back-projection (B, D, H, W): sum over views of `image(u, v) / depth^2`, images (B, V, rows, cols).

    Images are interpolated bilinearly and fade to zero over one pixel beyond the outermost pixel centres. Voxels behind
    the source get zero.
    """
    rows, cols = images.shape[2:]
    volume = images.new_zeros(len(images), shape[0] * shape[1] * shape[2])
    for part, voxels in _parts(shape, matrices):
        for view, matrix in enumerate(matrices):
            for pixel, weight in _pixels_around(matrix @ voxels, rows, cols):
                volume[:, part] += images[:, view].flatten(1)[:, pixel] * weight.to(images.dtype)
    return volume.reshape(len(images), *shape)


def spread_over_images(volume: Tensor, matrices: Tensor, rows: int, cols: int) -> Tensor:
    """Adjoint of `backproject_by_voxels`: volume (B, D, H, W) into (B, V, rows, cols)."""
    _, depth, height, width = volume.shape
    shape = (depth, height, width)
    images = volume.new_zeros(len(volume), len(matrices), rows * cols)
    for part, voxels in _parts(shape, matrices):
        values = volume.flatten(1)[:, part]
        for view, matrix in enumerate(matrices):
            for pixel, weight in _pixels_around(matrix @ voxels, rows, cols):
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


def _pixels_around(homogeneous: Tensor, rows: int, cols: int) -> list[tuple[Tensor, Tensor]]:
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
    """The two pixels around each position and their linear weights, 0 outside the image."""
    position = position.clamp(-2, count + 1)
    below = position.floor()
    pairs = ((below, below + 1 - position), (below + 1, position - below))
    return [(i.clamp(0, count - 1).long(), share * ((i >= 0) & (i < count))) for i, share in pairs]

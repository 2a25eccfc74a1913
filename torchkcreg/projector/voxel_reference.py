"""Joseph's projector through voxels in plain torch: the readable definition that every other backend has to match.

Everything here is in voxel indices, x, y, z order. A view is a matrix ``[D | s]`` of shape (3, 4): the source is at
``s`` and the ray of pixel (u, v) runs along ``d = D (u, v, 1)``, at depth t at ``s + t d``.

Joseph 1982, "An improved algorithm for reprojecting rays through pixel images": a ray is sampled where it crosses the
lattice planes of its major axis, the one along which its index changes most, by bilinear interpolation in the plane.
Beyond the outermost centres a value fades to zero over one voxel, so every voxel counts in full.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

AXIS_BIAS = (1.0, 1.0 - 1e-6, 1.0 - 2e-6)  # at 45 degrees rounding must not choose the major axis
SAMPLES_AT_ONCE = 1 << 20  # bounds the memory; changes sums in the last bits at most
VOXELS_AT_ONCE = 1 << 19  # bounds the memory


def project_by_planes(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int) -> Tensor:
    """Path integrals (B, V, rows, cols) of volume (B, D, H, W); rays (V, 3, 4) and spacing (3,) in float64."""
    values, (depth, height, width) = volume.flatten(1), volume.shape[1:]
    images = volume.new_zeros(len(volume), len(rays), rows * cols)
    for view, ray in enumerate(rays):
        for pixels, voxels, weights in _samples(ray, spacing, (depth, height, width), rows, cols):
            sampled = values[:, voxels] * weights.to(volume.dtype)
            images[:, view, pixels] += sampled.sum((1, 2))
    return images.reshape(len(volume), len(rays), rows, cols)


def backproject_by_planes(images: Tensor, rays: Tensor, spacing: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """The adjoint of `project_by_planes`: images (B, V, rows, cols) into (B, D, H, W)."""
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
    """What a view adds up: pixels (n,), the voxels (planes, 4, n) that they see and with which weights, part by part.

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
        others = [other for other in range(3) if other != axis]
        planes_at_once = max(1, SAMPLES_AT_ONCE // (4 * len(pixels)))
        for plane in torch.arange(counts[axis], device=ray.device).split(planes_at_once):
            distance = plane[:, None] - source[axis]
            ahead = distance * direction[axis] > 0  # a ray starts at the source
            voxels, weights = plane[:, None, None] * strides[axis], (step * ahead)[:, None]
            for other in others:
                position = source[other] + distance * (direction[other] / direction[axis])
                index, share = _neighbours(position, counts[other])
                voxels = (voxels[:, :, None] + index[:, None] * strides[other]).flatten(1, 2)
                weights = (weights[:, :, None] * share[:, None]).flatten(1, 2)
            yield pixels, voxels, weights


def pixel_directions(ray: Tensor, rows: int, cols: int) -> Tensor:
    """Directions (3, rows * cols) of the rays of a view at depth 1."""
    u = torch.arange(cols, dtype=ray.dtype, device=ray.device)
    v = torch.arange(rows, dtype=ray.dtype, device=ray.device)[:, None]
    return (ray[:, 0, None, None] * u + ray[:, 1, None, None] * v + ray[:, 2, None, None]).flatten(1)


def _neighbours(position: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The two lattice points around each position (planes, n) and their linear weights, both (planes, 2, n).

    Points beyond the lattice have weight 0 and an index that is safe to read.
    """
    below = position.clamp(-2, count + 1).floor()
    fraction = position - below
    index = torch.stack([below, below + 1], 1)
    share = torch.stack([1 - fraction, fraction], 1)
    inside = (index >= 0) & (index < count)
    return index.clamp(0, count - 1).long(), share * inside


def backproject_by_voxels(images: Tensor, matrices: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """``sum over views of image(u, v) / depth^2`` at each voxel, (B, D, H, W), from images (B, V, rows, cols).

    Images are interpolated bilinearly and fade to zero over one pixel beyond the outermost pixel centres. Voxels behind
    the source get nothing.
    """
    rows, cols = images.shape[2:]
    volume = images.new_zeros(len(images), shape[0] * shape[1] * shape[2])
    for part, voxels in _parts(shape, matrices):
        for view, matrix in enumerate(matrices):
            for pixel, weight in _pixels_around(matrix @ voxels, rows, cols):
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
    """The two pixels around each position and their weights, 0 beyond the image."""
    position = position.clamp(-2, count + 1)
    below = position.floor()
    pairs = ((below, below + 1 - position), (below + 1, position - below))
    return [(i.clamp(0, count - 1).long(), share * ((i >= 0) & (i < count))) for i, share in pairs]

"""Chord lengths through solids along the rays of a view."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.simulation.solids import Convex, Solid

BLOCK_ROWS = 64  # detector rows whose rays are traced together


def chord_lengths(solid: Solid, origin: Tensor, directions: Tensor, *, within: Solid | None = None) -> Tensor:
    """Lengths in mm `(...)` of rays from `origin` (3,) along unit `directions` `(..., 3)` inside a solid.

    Args:
        solid: What is crossed.
        origin: The source.
        directions: Unit vectors.
        within: If given, only what lies inside this solid too counts; it must have no cavity.

    >>> from torchkcreg.simulation import Sphere
    >>> along_z = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    >>> chord_lengths(Sphere([0, 0, 0], 2.0), -9 * along_z[0], along_z)
    tensor([4.], dtype=torch.float64)
    """
    bodies = [solid.hull]
    if within is not None:
        if within.cavity is not None:
            raise ValueError("within must be a solid without a cavity")
        bodies.append(within.hull)
    length = _common_length(bodies, origin, directions)
    if solid.cavity is not None:
        length = length - _common_length([*bodies, solid.cavity], origin, directions)
    return length


def chord_image(
    solid: Solid, matrix: Tensor, det_shape: tuple[int, int], *, rays: int = 2, within: Solid | None = None
) -> Tensor:
    """Chord lengths in mm (rows, cols), float64, the mean of `rays` x `rays` rays a pixel.

    Args:
        solid: What is crossed, in the world's frame.
        matrix: Projection matrix (3, 4).
        det_shape: Rows and columns.
        rays: Rays along each side of a pixel.
        within: As in `chord_lengths`.
    """
    matrix = matrix.double()
    image = matrix.new_zeros(det_shape)
    rows, cols = _shadow(solid.corners() if within is None else within.corners(), matrix, det_shape)
    inverse = torch.linalg.inv(matrix[:, :3])
    origin = -inverse @ matrix[:, 3]
    u = _ray_positions(cols, rays)
    for start in range(rows.start, rows.stop, BLOCK_ROWS):
        block = range(start, min(start + BLOCK_ROWS, rows.stop))
        v = _ray_positions(block, rays)
        directions = inverse[:, 0] * u[:, None] + inverse[:, 1] * v[:, None, None] + inverse[:, 2]
        directions = directions / directions.norm(dim=-1, keepdim=True)
        lengths = chord_lengths(solid, origin, directions, within=within)
        means = lengths.reshape(len(block), rays, len(cols), rays).mean((1, 3))
        image[block.start : block.stop, cols.start : cols.stop] = means
    return image


def _common_length(bodies: Sequence[Convex], origin: Tensor, directions: Tensor) -> Tensor:
    """Length inside all of some convex bodies."""
    enters, leaves = zip(*(body.interval(origin, directions) for body in bodies))
    return (torch.stack(leaves).amin(0) - torch.stack(enters).amax(0)).clamp_min(0)


def _shadow(corners: Tensor, matrix: Tensor, det_shape: tuple[int, int]) -> tuple[range, range]:
    """Rows and columns that a solid between these corners can darken."""
    homogeneous = corners @ matrix[:, :3].T + matrix[:, 3]
    if bool((homogeneous[:, 2] <= 0).any()):
        return range(det_shape[0]), range(det_shape[1])
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    low, high = (pixels.amin(0) - 1).floor().tolist(), (pixels.amax(0) + 2).ceil().tolist()
    ranges = [range(max(0, int(a)), min(size, int(b))) for a, b, size in zip(low, high, det_shape[::-1])]
    return ranges[1], ranges[0]


def _ray_positions(pixels: range, rays: int) -> Tensor:
    """Pixel coordinates of the rays of a run of pixels, centres at whole numbers."""
    fine = torch.arange(pixels.start * rays, max(pixels.stop, pixels.start) * rays, dtype=torch.float64)
    return (fine + 0.5) / rays - 0.5

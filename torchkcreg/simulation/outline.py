"""Flat outline of a plate with holes, triangulated in regular patches: one around each hole, one at each end."""

from __future__ import annotations

import math

import numpy as np

DECIMALS = 6  # of points in mm: points closer than a nanometre are merged
CORNER_SHARE = 0.25  # length of a rounded end at the plate's edges, relative to its middle


def plate_outline(
    length: float,
    width: float,
    num_holes: int,
    hole_radius: float,
    end_margin: float,
    max_edge: float,
    hole_offset: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) in (x, z) and triangles (m, 3) of a plate along z with a row of holes and rounded ends.

    All triangles have the same orientation. Sizes are in mm, as in `locking_plate`. A hole is the union of two circles
    whose centres lie `hole_offset` before and behind its middle.

    Raises:
        ValueError: If a hole does not fit into its patch, or the ends leave no room.
    """
    pitch = (length - 2 * end_margin) / max(num_holes, 1)
    if num_holes < 1 or not 0 < end_margin < length / 2:
        raise ValueError(f"num_holes and end_margin must fit a length of {length}, got {num_holes} and {end_margin}")
    if not (0 < hole_radius < 0.95 * width / 2 and hole_radius + hole_offset < 0.95 * pitch / 2):
        raise ValueError(f"hole_radius must be positive and fit into {pitch:g} x {width:g} mm, got {hole_radius}")
    if not 0 <= hole_offset < hole_radius:
        raise ValueError(f"hole_offset must lie between 0 and the hole's radius, got {hole_offset}")
    across, along = math.ceil(width / max_edge), math.ceil(pitch / max_edge)
    centers = [(hole - (num_holes - 1) / 2) * pitch for hole in range(num_holes)]
    shape = (hole_radius, hole_offset)
    holes = [_hole_patch(center, width, pitch, shape, across, along, max_edge) for center in centers]
    start = length / 2 - end_margin
    ends = [_end_patch(side, start, width, end_margin, across, max_edge) for side in (-1, 1)]
    return _merged(holes + ends)


def _hole_patch(
    center: float,
    width: float,
    height: float,
    shape: tuple[float, float],
    across: int,
    along: int,
    max_edge: float,
) -> np.ndarray:
    """Grid (layers + 1, around, 2) from a hole's rim out to its rectangle, the first point repeated at the end."""
    x = np.linspace(-width / 2, width / 2, across + 1)
    z = np.linspace(-height / 2, height / 2, along + 1)
    rectangle = np.concatenate(
        [
            np.stack([np.full(along, width / 2), z[:-1]], axis=1),
            np.stack([x[:0:-1], np.full(across, height / 2)], axis=1),
            np.stack([np.full(along, -width / 2), z[:0:-1]], axis=1),
            np.stack([x[:-1], np.full(across, -height / 2)], axis=1),
        ]
    )
    rectangle = np.concatenate([rectangle, rectangle[:1]])
    radius, offset = shape
    outwards = rectangle / np.linalg.norm(rectangle, axis=1, keepdims=True)
    # the farther of the two circles along each direction from the middle between their centres
    reach = offset * np.abs(outwards[:, 1:]) + np.sqrt(radius**2 - (offset * outwards[:, :1]) ** 2)
    rim = reach * outwards
    layers = math.ceil((math.hypot(width, height) / 2 - radius) / max_edge)
    share = np.linspace(0, 1, layers + 1)[:, None, None]
    return rim + share * (rectangle - rim) + [0.0, center]


def _end_patch(side: int, start: float, width: float, margin: float, across: int, max_edge: float) -> np.ndarray:
    """Grid (layers + 1, across + 1, 2) from the last hole's rectangle to the plate's rounded end."""
    x = np.linspace(-width / 2, width / 2, across + 1)
    reach = margin * (CORNER_SHARE + (1 - CORNER_SHARE) * np.sqrt(np.maximum(0, 1 - (2 * x / width) ** 2)))
    layers = math.ceil(margin / max_edge)
    z = side * (start + np.linspace(0, 1, layers + 1)[:, None] * reach)
    return np.stack(np.broadcast_arrays(x, z), axis=2)


def _merged(patches: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Merge grids of points with common borders into one triangulation of uniformly oriented triangles."""
    points, triangles, first = [], [], 0
    for patch in patches:
        rows, cols = patch.shape[:2]
        index = first + np.arange(rows * cols).reshape(rows, cols)
        a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        points.append(patch.reshape(-1, 2))
        triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
        first += rows * cols
    _, first_index, merged_index = np.unique(
        np.concatenate(points).round(DECIMALS), axis=0, return_index=True, return_inverse=True
    )
    flat, joined = np.concatenate(points)[first_index], merged_index.ravel()[np.concatenate(triangles)]
    edges = flat[joined[:, 1:]] - flat[joined[:, :1]]
    clockwise = edges[:, 0, 0] * edges[:, 1, 1] < edges[:, 0, 1] * edges[:, 1, 0]
    joined[clockwise] = joined[clockwise, ::-1]
    return flat, joined

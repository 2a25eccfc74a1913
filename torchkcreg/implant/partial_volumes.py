"""Exact fraction of each lattice cell inside a closed triangle mesh, by clipping the triangles to the cells.

The divergence theorem turns the volume inside a cell into a sum over the surface. A piece of triangle in cell k of a
column bounds the material below it: part of cell k and all cells under it. Each triangle is cut at the faces of the
cells, the pieces are integrated in closed form, and a running sum down each column fills the interior. There is no
sampling and no ray that could hit an edge, and the sum over all cells is the volume of the mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_EMPTY = 1e-9  # a smaller fraction is a rounding error
_CHUNK = 20_000  # polygons clipped at a time, to bound memory


class FilledCells(NamedTuple):
    """Cells that a mesh fills partly or wholly.

    Attributes:
        indices: (n, 3), cell i spans [i, i + 1] along each axis.
        fractions: (n,), between 0 and 1 up to rounding, unless the mesh overlaps itself.
        centroids: (n, 3), centroid of the part inside, in cell coordinates from 0 to 1.
    """

    indices: Integers
    fractions: Floats
    centroids: Floats


def fill_cells(triangles: Floats) -> FilledCells:
    """Unit cells filled by the closed surface of triangles (m, 3, 3), counter-clockwise seen from outside.

    >>> corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], dtype=float)
    >>> tetrahedron = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    >>> cells = fill_cells(tetrahedron)
    >>> [(tuple(map(int, i)), round(float(f), 4)) for i, f in zip(cells.indices, cells.fractions)]
    [((0, 0, 0), 0.8333), ((0, 0, 1), 0.1667), ((0, 1, 0), 0.1667), ((1, 0, 0), 0.1667)]
    """
    triangles = np.asarray(triangles, dtype=np.float64)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    # triangles parallel to the columns need no integration: choose the direction with the most of them
    needed = (np.linalg.norm(normals, axis=1)[:, None] * (normals != 0)).sum(0)
    axis = int(np.argmin(needed))
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]  # cyclic, so that the winding stays the same
    polygons = triangles[normals[:, axis] != 0][:, :, order]
    cells, sums = _merge(*_pieces(polygons))
    indices, fractions, moments = _run_down_columns(cells, sums)
    filled = np.abs(fractions) > _EMPTY
    centroids = np.clip(moments[filled] / fractions[filled, None], 0.0, 1.0)
    back = [order.index(i) for i in range(3)]
    indices, fractions, centroids = indices[filled][:, back], fractions[filled], centroids[:, back]
    sort = np.lexsort(indices.T[::-1])
    return FilledCells(indices[sort], fractions[sort], centroids[sort])


def _pieces(polygons: Floats) -> tuple[Integers, Floats]:
    """Cells (n, 3) and integrals (n, 7) of the triangle pieces within single cells."""
    cells, sums = [np.zeros((0, 3), np.int64)], [np.zeros((0, 7))]
    # a large triangle makes many pieces, so the chunks are made of strips along one axis
    strips, counts = _cut(polygons, np.full(len(polygons), 3), axis=0)
    for start in range(0, len(strips), _CHUNK):
        part = strips[start : start + _CHUNK], counts[start : start + _CHUNK]
        for axis in (1, 2):
            part = _cut(*part, axis=axis)
        corner, integrals = _integrate(part[0])
        cells.append(corner)
        sums.append(integrals)
    return np.concatenate(cells), np.concatenate(sums)


def _cut(polygons: Floats, counts: Integers, axis: int) -> tuple[Floats, Integers]:
    """Cut convex polygons (n, K, 3) of `counts` vertices at integer coordinates along an axis.

    Unused vertices repeat the first one, here and everywhere below.
    """
    low = np.floor(polygons[:, :, axis].min(1)).astype(np.int64)
    high = np.ceil(polygons[:, :, axis].max(1)).astype(np.int64)
    slabs = np.maximum(high - low, 1)
    whole = slabs == 1
    parent = np.repeat(np.flatnonzero(~whole), slabs[~whole])
    first = np.cumsum(slabs[~whole]) - slabs[~whole]
    slab = low[parent] + np.arange(len(parent)) - np.repeat(first, slabs[~whole])
    cut, cut_counts = _clip(polygons[parent], counts[parent], axis, slab, 1.0)
    nonempty = cut_counts > 0
    cut, cut_counts = _clip(cut[nonempty], cut_counts[nonempty], axis, slab[nonempty] + 1, -1.0)
    nonempty = cut_counts > 2
    wide = max(polygons.shape[1], cut.shape[1])
    joined = np.concatenate([_widen(polygons[whole], wide), _widen(cut[nonempty], wide)])
    return joined, np.concatenate([counts[whole], cut_counts[nonempty]])


def _widen(polygons: Floats, width: int) -> Floats:
    if polygons.shape[1] == width:
        return polygons
    return np.concatenate([polygons, np.repeat(polygons[:, :1], width - polygons.shape[1], axis=1)], axis=1)


def _clip(polygons: Floats, counts: Integers, axis: int, bound: Integers, sign: float) -> tuple[Floats, Integers]:
    """Polygons clipped to `sign * (x - bound) >= 0` along an axis (Sutherland and Hodgman 1974)."""
    if len(polygons) == 0:
        return polygons, counts
    used = np.arange(polygons.shape[1]) < counts[:, None]
    above = sign * (polygons[:, :, axis] - bound[:, None])
    above_next = np.roll(above, -1, axis=1)  # the last vertex is followed by the first, repeated or by wrapping
    inside = above >= 0
    crosses = (inside != (above_next >= 0)) & used
    step = np.divide(above, above - above_next, out=np.zeros_like(above), where=crosses)
    crossing = polygons + step[:, :, None] * (np.roll(polygons, -1, axis=1) - polygons)
    crossing[:, :, axis] = bound[:, None]
    used_slots = np.stack([inside & used, crosses], axis=2).reshape(len(polygons), -1)
    candidates = np.stack([polygons, crossing], axis=2).reshape(len(polygons), -1, 3)
    counts = used_slots.sum(1)
    row, column = np.nonzero(used_slots)
    slot = np.cumsum(used_slots, axis=1)[row, column] - 1
    first = candidates[np.arange(len(polygons)), used_slots.argmax(1)]
    clipped = np.repeat(first[:, None], max(int(counts.max()), 1), axis=1)
    clipped[row, slot] = candidates[row, column]
    return clipped, counts


def _integrate(polygons: Floats) -> tuple[Integers, Floats]:
    """Cells (n, 3) that contain the polygons, and integrals (n, 7) over their projections on the floor of the cell.

    With x, y, z relative to the cell's corner, the integrands are 1, x, y (for the full cells below), then z, x z, y z,
    z^2/2 (for the part of this cell below the polygon). Projected areas are signed: downward faces count negative.
    """
    lowest = polygons.min(1)
    middle = (lowest + polygons.max(1)) / 2  # inside the cell, whereas corners may lie on a face between two cells
    cells = np.where(lowest == polygons.max(1), np.floor(lowest), np.floor(middle)).astype(np.int64)
    x, y, z = np.moveaxis(polygons - cells[:, None], -1, 0)
    # a fan of triangles around the first vertex: (n, K - 2)
    edge_x, edge_y = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1]
    area = (edge_x[:, :-1] * edge_y[:, 1:] - edge_y[:, :-1] * edge_x[:, 1:]) / 2
    sum_x, sum_y, sum_z = (c[:, :1] + c[:, 1:-1] + c[:, 2:] for c in (x, y, z))

    def product(p: Floats, q: Floats, sum_p: Floats, sum_q: Floats) -> Floats:
        """Integral of p q, both linear: a twelfth of the area times this sum over the vertices."""
        square = p * q
        return np.einsum("nk,nk->n", area, sum_p * sum_q + square[:, :1] + square[:, 1:-1] + square[:, 2:]) / 12

    linear = [np.einsum("nk,nk->n", area, total) / 3 for total in (sum_x, sum_y, sum_z)]
    products = [product(x, z, sum_x, sum_z), product(y, z, sum_y, sum_z), product(z, z, sum_z, sum_z) / 2]
    sums = np.stack([area.sum(1), *linear, *products], axis=1)
    return cells, sums


def _merge(cells: Integers, sums: Floats) -> tuple[Integers, Floats]:
    """Distinct cells, ordered by column and then upwards, and the sums over their pieces."""
    if len(cells) == 0:
        return cells, sums
    low = cells.min(0)
    size = cells.max(0) - low + 1
    keys = ((cells[:, 0] - low[0]) * size[1] + cells[:, 1] - low[1]) * size[2] + cells[:, 2] - low[2]
    keys, inverse = np.unique(keys, return_inverse=True)
    merged: Floats = np.stack([np.bincount(inverse, weights=column, minlength=len(keys)) for column in sums.T], axis=1)
    rest, k = np.divmod(keys, size[2])
    i, j = np.divmod(rest, size[1])
    distinct: Integers = np.stack([i, j, k], axis=1) + low
    return distinct, merged


def _run_down_columns(cells: Integers, sums: Floats) -> tuple[Integers, Floats, Floats]:
    """Indices, fractions and first moments of all cells, including full cells between pieces of surface."""
    # over each column the sum of a closed surface is zero, so one running sum from the end serves all columns
    above = np.cumsum(sums[::-1, :3], axis=0)[::-1] - sums[:, :3]
    fractions = sums[:, 3] + above[:, 0]
    moments = sums[:, 4:] + above[:, [1, 2, 0]] * [1.0, 1.0, 0.5]
    same_column = (cells[1:, :2] == cells[:-1, :2]).all(1)
    gaps = np.where(same_column & (np.abs(above[:-1, 0]) > _EMPTY), cells[1:, 2] - cells[:-1, 2] - 1, 0)
    below = np.repeat(np.arange(len(gaps)), gaps)
    between = cells[below]
    between[:, 2] += 1 + np.arange(len(below)) - np.repeat(np.cumsum(gaps) - gaps, gaps)
    indices = np.concatenate([cells, between])
    full = above[below]
    return indices, np.append(fractions, full[:, 0]), np.concatenate([moments, full[:, [1, 2, 0]] * [1.0, 1.0, 0.5]])

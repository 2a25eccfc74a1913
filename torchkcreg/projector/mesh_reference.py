"""Signed depths of projected triangles integrated over each pixel: the reference in torch for the kernels."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchkcreg.kernels.differentiable import is_transformed

MAX_PAIRS = 1 << 20  # (triangle, pixel) pairs processed at once
MAX_CLIPPED_PAIRS = 1 << 14  # pairs clipped at once, so that their data fit in a core's cache


def integrate_triangles(projected: Tensor, faces: Tensor, rows: int, cols: int) -> Tensor:
    """Sums over triangles of the signed depth integrated over each pixel, (B, rows, cols).

    Args:
        projected: Vertices (B, n, 3) as u, v, w = 1 / depth; pixel (row, col) is [col, col + 1] x [row, row + 1].
        faces: Vertex indices (m, 3).
        rows: Rows of the detector.
        cols: Columns of the detector.
    """
    images = [_integrate(shape, faces, (rows, cols)) for shape in projected]
    return torch.stack(images) if images else projected.new_zeros(0, rows, cols)


def _integrate(projected: Tensor, faces: Tensor, det_shape: tuple[int, int]) -> Tensor:
    """Image (rows, cols) of one set of projected vertices (n, 3)."""
    rows, cols = det_shape
    corners = projected.index_select(0, faces.flatten()).reshape(-1, 3, 3)
    image = corners.new_zeros(rows * cols)
    for triangles, row, col in _pairs(corners.detach(), det_shape):
        inside, crossing = _classify(corners.detach(), triangles, row, col)
        covered, row_in, col_in = triangles[inside], row[inside], col[inside]
        image = image.index_add(0, row_in * cols + col_in, _whole_pixels(corners, covered, row_in, col_in))
        parts = (x[crossing].split(MAX_CLIPPED_PAIRS) for x in (triangles, row, col))
        for triangle, row_cut, col_cut in zip(*parts):
            if corners.requires_grad and torch.is_grad_enabled() and not is_transformed(corners):
                values = checkpoint(_cut_pixels, corners, triangle, row_cut, col_cut, use_reentrant=False)
            else:
                values = _cut_pixels(corners, triangle, row_cut, col_cut)
            image = image.index_add(0, row_cut * cols + col_cut, values)
    return image.reshape(rows, cols)


def _pairs(corners: Tensor, det_shape: tuple[int, int]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Pairs of a triangle and a pixel of its bounding box as (triangle, row, column), in chunks."""
    rows, cols = det_shape
    low, high = corners[:, :, :2].amin(1).floor(), corners[:, :, :2].amax(1).floor() + 1
    limits = corners.new_tensor([cols, rows])
    low = low.clamp(min=torch.zeros_like(limits), max=limits).long()
    high = high.clamp(min=torch.zeros_like(limits), max=limits).long()
    size = high - low
    counts = size.prod(dim=1)
    chunk = (counts.cumsum(0) - counts) // MAX_PAIRS
    for triangles in torch.arange(len(counts), device=corners.device).split(torch.bincount(chunk).tolist()):
        count = counts[triangles]
        triangle = triangles.repeat_interleave(count)
        start = (count.cumsum(0) - count).repeat_interleave(count)
        index = torch.arange(len(triangle), device=corners.device) - start
        width = size[triangle, 0]
        row = torch.div(index, width, rounding_mode="floor")
        yield triangle, low[triangle, 1] + row, low[triangle, 0] + index - row * width


def _classify(corners: Tensor, triangle: Tensor, row: Tensor, col: Tensor) -> tuple[Tensor, Tensor]:
    """Masks of pairs whose pixel is wholly inside the triangle, and of pairs that its outline may cut."""
    u, v = corners[..., 0], corners[..., 1]
    du, dv = u.roll(-1, 1) - u, v.roll(-1, 1) - v
    orientation = (du[:, 0] * dv[:, 1] - dv[:, 0] * du[:, 1]).sign()[:, None]
    du, dv = du * orientation, dv * orientation
    # edge functions are positive inside; over a pixel they vary by +-(|du| + |dv|) / 2 about their centre value
    constant, spread = du * v - dv * u, (du.abs() + dv.abs()) / 2
    centre_u, centre_v = col + 0.5, row + 0.5
    inside = (orientation[:, 0] != 0)[triangle]
    crossing = inside.clone()
    for edge in range(3):
        value = du[triangle, edge] * centre_v - dv[triangle, edge] * centre_u - constant[triangle, edge]
        reach = spread[triangle, edge]
        inside &= value > reach
        crossing &= value >= -reach
    return inside, crossing & ~inside


def _whole_pixels(corners: Tensor, triangle: Tensor, row: Tensor, col: Tensor) -> Tensor:
    """Mean signed depth of triangles over pixels that they cover completely."""
    used, triangle = torch.unique(triangle, return_inverse=True)
    origin, first, second = corners.index_select(0, used).unbind(1)
    first, second = first - origin, second - origin
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    slope_u = (first[:, 2] * second[:, 1] - second[:, 2] * first[:, 1]) / area
    slope_v = (second[:, 2] * first[:, 0] - first[:, 2] * second[:, 0]) / area
    constant = origin[:, 2] - slope_u * origin[:, 0] - slope_v * origin[:, 1]
    planes = torch.stack([constant, slope_u, slope_v, area.sign()], dim=1).index_select(0, triangle)
    centre = planes[:, 0] + planes[:, 1] * (col + 0.5) + planes[:, 2] * (row + 0.5)
    variance = (planes[:, 1] ** 2 + planes[:, 2] ** 2) / 12
    return planes[:, 3] / centre * (1 + variance / centre**2)


def _cut_pixels(corners: Tensor, triangle: Tensor, row: Tensor, col: Tensor) -> Tensor:
    """Signed depth of triangles integrated over the part of the pixel that they cover."""
    polygon = corners.index_select(0, triangle)
    zero = torch.zeros_like(col)
    polygon = polygon - torch.stack([col, row, zero], dim=1).to(polygon)[:, None]
    for axis in (0, 1):
        # an edge on the border of two pixels counts for the second, for the triangles on both sides of the edge
        polygon = _clip(polygon, polygon[..., axis], polygon[..., axis] >= 0)
        polygon = _clip(polygon, 1 - polygon[..., axis], polygon[..., axis] < 1)
    u, v, w = polygon.unbind(-1)
    first_u, first_v, first_w = u[:, :1], v[:, :1], w[:, :1]
    du, dv = u[:, 1:] - first_u, v[:, 1:] - first_v
    area = (du[:, :-1] * dv[:, 1:] - dv[:, :-1] * du[:, 1:]) / 2
    return (area * _mean_reciprocal(first_w, w[:, 1:-1], w[:, 2:])).sum(1)


def _clip(polygon: Tensor, height: Tensor, is_inside: Tensor) -> Tensor:
    """Clip convex polygons (P, k, 3) where the height (P, k) of their vertices is zero; the result is (P, k + 1, 3).

    The result lists the inside vertices, the crossing where the outline leaves (repeated to fill the row), and the
    crossing where it re-enters. Polygons wholly outside collapse to zero area.
    """
    size = polygon.shape[1]
    number = is_inside.sum(1, keepdim=True)
    entering = is_inside & ~is_inside.roll(1, 1)
    start = entering.to(torch.uint8).argmax(1, keepdim=True)  # 0 where the outline never leaves
    steps = torch.arange(size, device=polygon.device)
    order = (start + steps) % size  # inside vertices first, then outside ones
    points = polygon.gather(1, order[..., None].expand_as(polygon))
    heights, inside = height.gather(1, order), is_inside.gather(1, order)
    last = (number - 1).clamp_min(0)
    leaves = _crossing(points, heights, inside, last, (last + 1).clamp_max(size - 1))
    enters = _crossing(points, heights, inside, torch.full_like(last, size - 1), torch.zeros_like(last))
    body = torch.where((steps < number)[..., None], points, leaves)
    closing = torch.where((number == size)[..., None], points[:, -1:], enters)
    return torch.cat([body, closing], dim=1)


def _crossing(points: Tensor, heights: Tensor, is_inside: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """Points (P, 1, 3) where the edge between two vertices (given by index) crosses height zero."""
    a, b = (points.gather(1, index[..., None].expand(-1, -1, 3)) for index in (inside, outside))
    h_a, h_b = heights.gather(1, inside), heights.gather(1, outside)
    crosses = is_inside.gather(1, inside) != is_inside.gather(1, outside)
    share = h_a / torch.where(crosses, h_a - h_b, torch.ones_like(h_a))
    return a + torch.where(crosses, share, torch.zeros_like(share))[..., None] * (b - a)


def _mean_reciprocal(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Mean of 1 / w over a triangle, for w affine with values a, b, c at the corners.

    Computed as a series in the deviation of w from its mean m: `1/m (1 + E2/m^2 - E3/m^3 + E4/m^4)`, with the
    triangle's moments `E2 = -e2/6, E3 = e3/10, E4 = e2^2/15` from the elementary symmetric polynomials of the corners'
    deviations.
    """
    mean = (a + b + c) / 3
    a, b, c = a / mean - 1, b / mean - 1, c / mean - 1
    pairs, product = a * b + a * c + b * c, a * b * c
    return (1 - pairs / 6 - product / 10 + pairs**2 / 15) / mean

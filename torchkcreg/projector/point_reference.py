"""Point-cloud DRR in plain torch: the reference that all other backends must match."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_DEPTH = 1e-3  # mm; nearer nodes are skipped, as their amplitude would overflow


def splat_points(
    points: Tensor,  # (B, N, 3)
    volumes: Tensor,  # (N,)
    matrices: Tensor,  # (V, 3, 4)
    table: Tensor,  # (V, num_blocks, R + 1, R + 1, T, T)
    block_size: int,
    rows: int,
    cols: int,
) -> Tensor:
    """Images (B, V, rows, cols) of nodes that each distribute `volume / depth^2` over their footprint.

    A node at pixel (u, v) contributes to T x T pixels, starting at `floor(u) - T / 2 + 1` and `floor(v) - T / 2 + 1`.
    Their values are interpolated bilinearly in the table at the node's sub-pixel position. Nodes behind the source or
    with NaN coordinates are skipped; pixels outside the detector are dropped.

    Differentiable in points, volumes and matrices by autograd; the table is constant. Runs on any device. On a GPU the
    order of summation, and so the last bits, may vary between runs.
    """
    images = []
    for candidate in points:
        for matrix, view_table in zip(matrices, table):
            images.append(_splat_view(candidate, volumes, matrix, view_table, block_size, rows, cols))
    shape = (len(points), len(matrices), rows, cols)
    return torch.stack(images).reshape(shape) if images else points.new_zeros(shape)


def _splat_view(
    points: Tensor, volumes: Tensor, matrix: Tensor, table: Tensor, block_size: int, rows: int, cols: int
) -> Tensor:
    taps, phases = table.shape[-1], table.shape[1] - 1
    u, v, depth, node = _visible_pixels(points, matrix, taps, rows, cols)
    col, phase_u, weight_u = _tap_position(u, taps, phases)
    row, phase_v, weight_v = _tap_position(v, taps, phases)

    block = torch.div(node, block_size, rounding_mode="floor")
    value = points.new_zeros(len(node), taps, taps)
    for step_v, share_v in ((0, 1 - weight_v), (1, weight_v)):
        for step_u, share_u in ((0, 1 - weight_u), (1, weight_u)):
            corner = table[block, phase_v + step_v, phase_u + step_u]
            value = value + (share_v * share_u)[:, None, None] * corner
    value = value * (volumes[node] / depth**2)[:, None, None]

    # A margin of T pixels around the image collects taps outside it, so that no tap needs a bounds check.
    tap = torch.arange(taps, device=points.device)
    width = cols + 2 * taps
    pixel = (row + taps)[:, None, None] * width + (col + taps)[:, None, None] + tap[:, None] * width + tap
    padded = points.new_zeros((rows + 2 * taps) * width).index_add(0, pixel.flatten(), value.flatten())
    return padded.reshape(rows + 2 * taps, width)[taps : taps + rows, taps : taps + cols]


def _visible_pixels(
    points: Tensor, matrix: Tensor, taps: int, rows: int, cols: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel coordinates u and v, depth and index of the nodes that reach the image."""
    with torch.no_grad():
        u, v, depth = _pixel_coordinates(points, matrix)
        # Comparisons with NaN are false, so NaN coordinates drop out here.
        seen = (depth > MIN_DEPTH) & (u >= -(taps // 2)) & (u < cols + taps // 2 - 1)
        seen &= (v >= -(taps // 2)) & (v < rows + taps // 2 - 1)
        node = seen.nonzero()[:, 0]
    return *_pixel_coordinates(points[node], matrix), node


def _pixel_coordinates(points: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    u, v, depth = (points @ matrix[:, :3].mT + matrix[:, 3]).unbind(-1)
    return u / depth, v / depth, depth


def _tap_position(coordinate: Tensor, taps: int, phases: int) -> tuple[Tensor, Tensor, Tensor]:
    """First pixel that a node contributes to, the lower tabulated phase, and the weight of the upper phase."""
    below = coordinate.detach().floor()
    position = (coordinate - below) * phases
    phase = position.detach().long().clamp(max=phases - 1)
    return below.long() - (taps // 2 - 1), phase, position - phase

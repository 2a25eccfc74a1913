"""Point-cloud DRR in Triton: one program per block of nodes and view (forward), or per block of nodes (backward).

Images are summed by atomic additions, so their last bits may differ from run to run. Gradients are reproducible.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_NODES = 128  # per program
_MIN_DEPTH = tl.constexpr(1e-3)  # mm, as in the reference


@triton.jit
def _seen(points, matrix, first, candidate, num_nodes, rows, cols, TAPS: tl.constexpr, NODES: tl.constexpr):
    """Nodes of a block: index, world and pixel position, inverse depth, and mask of those that reach the image."""
    node = first + tl.arange(0, NODES)
    there = node < num_nodes
    at = points + (candidate * num_nodes + node) * 3
    x = tl.load(at, mask=there, other=0.0)
    y = tl.load(at + 1, mask=there, other=0.0)
    z = tl.load(at + 2, mask=there, other=0.0)
    big_u = tl.load(matrix) * x + tl.load(matrix + 1) * y + tl.load(matrix + 2) * z + tl.load(matrix + 3)
    big_v = tl.load(matrix + 4) * x + tl.load(matrix + 5) * y + tl.load(matrix + 6) * z + tl.load(matrix + 7)
    depth = tl.load(matrix + 8) * x + tl.load(matrix + 9) * y + tl.load(matrix + 10) * z + tl.load(matrix + 11)
    near = there & (depth > _MIN_DEPTH)  # comparisons with NaN are false: such nodes drop out here
    inverse = 1.0 / tl.where(near, depth, 1.0)
    u, v = big_u * inverse, big_v * inverse
    seen = near & (u >= -(TAPS // 2)) & (u < cols + TAPS // 2 - 1) & (v >= -(TAPS // 2)) & (v < rows + TAPS // 2 - 1)
    return node, x, y, z, tl.where(seen, u, 0.0), tl.where(seen, v, 0.0), inverse, seen


@triton.jit
def _phase(coordinate, TAPS: tl.constexpr, PHASES: tl.constexpr):
    """First pixel that a node reaches, lower tabulated phase, and weight of the upper phase."""
    below = tl.floor(coordinate)
    position = (coordinate - below) * PHASES
    phase = tl.minimum(position.to(tl.int32), PHASES - 1)
    return below.to(tl.int32) - (TAPS // 2 - 1), phase, position - phase


@triton.jit
def _splat(
    points, volumes, matrices, table, images, num_nodes, num_views, num_blocks, block_size, rows, cols,
    TAPS: tl.constexpr, PHASES: tl.constexpr, NODES: tl.constexpr,
):  # fmt: skip
    candidate, view = tl.program_id(1) // num_views, tl.program_id(1) % num_views
    node, _, _, _, u, v, inverse, seen = _seen(
        points, matrices + view * 12, tl.program_id(0) * NODES, candidate, num_nodes, rows, cols, TAPS, NODES
    )
    col, phase_u, right = _phase(u, TAPS, PHASES)
    row, phase_v, down = _phase(v, TAPS, PHASES)
    amplitude = tl.load(volumes + node, mask=seen, other=0.0) * inverse * inverse
    line: tl.constexpr = (PHASES + 1) * TAPS * TAPS  # entries from one phase along v to the next
    entry = table + (view * num_blocks + node // block_size).to(tl.int64) * (PHASES + 1) * line
    entry += phase_v * line + phase_u * TAPS * TAPS
    image = images + tl.program_id(1).to(tl.int64) * rows * cols
    for tap in range(TAPS * TAPS):
        r, c = row + tap // TAPS, col + tap % TAPS
        inside = seen & (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
        upper_left = tl.load(entry + tap, mask=inside, other=0.0)
        upper_right = tl.load(entry + tap + TAPS * TAPS, mask=inside, other=0.0)
        lower_left = tl.load(entry + tap + line, mask=inside, other=0.0)
        lower_right = tl.load(entry + tap + line + TAPS * TAPS, mask=inside, other=0.0)
        upper = upper_left + right * (upper_right - upper_left)
        lower = lower_left + right * (lower_right - lower_left)
        tl.atomic_add(image + r * cols + c, amplitude * (upper + down * (lower - upper)), mask=inside)


@triton.jit
def _gather(
    grad, points, volumes, matrices, table, to_points, to_volumes, to_matrices,
    num_nodes, num_views, num_blocks, block_size, rows, cols,
    TAPS: tl.constexpr, PHASES: tl.constexpr, NODES: tl.constexpr, MATRICES: tl.constexpr,
):  # fmt: skip
    """Gradients to a block's nodes, and its contributions (programs, V, 12) to those of the matrices."""
    candidate, first = tl.program_id(1), tl.program_id(0) * NODES
    line: tl.constexpr = (PHASES + 1) * TAPS * TAPS
    zero = tl.zeros([NODES], dtype=points.dtype.element_ty)
    of_x, of_y, of_z, of_volume = zero, zero, zero, zero
    for view in range(num_views):
        matrix = matrices + view * 12
        node, x, y, z, u, v, inverse, seen = _seen(points, matrix, first, candidate, num_nodes, rows, cols, TAPS, NODES)
        col, phase_u, right = _phase(u, TAPS, PHASES)
        row, phase_v, down = _phase(v, TAPS, PHASES)
        entry = table + (view * num_blocks + node // block_size).to(tl.int64) * (PHASES + 1) * line
        entry += phase_v * line + phase_u * TAPS * TAPS
        image = grad + (candidate * num_views + view).to(tl.int64) * rows * cols
        upper_left, upper_right, lower_left, lower_right = zero, zero, zero, zero
        for tap in range(TAPS * TAPS):
            r, c = row + tap // TAPS, col + tap % TAPS
            inside = seen & (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
            g = tl.load(image + r * cols + c, mask=inside, other=0.0)
            upper_left += g * tl.load(entry + tap, mask=inside, other=0.0)
            upper_right += g * tl.load(entry + tap + TAPS * TAPS, mask=inside, other=0.0)
            lower_left += g * tl.load(entry + tap + line, mask=inside, other=0.0)
            lower_right += g * tl.load(entry + tap + line + TAPS * TAPS, mask=inside, other=0.0)
        upper = upper_left + right * (upper_right - upper_left)
        lower = lower_left + right * (lower_right - lower_left)
        value = upper + down * (lower - upper)
        of_volume += value * inverse * inverse
        amplitude = tl.load(volumes + node, mask=seen, other=0.0) * inverse * inverse
        slope = upper_right - upper_left + down * (lower_right - lower_left - upper_right + upper_left)
        of_u, of_v = amplitude * PHASES * slope * inverse, amplitude * PHASES * (lower - upper) * inverse
        of_w = -(of_u * u + of_v * v + 2.0 * amplitude * value * inverse)
        of_x += tl.load(matrix) * of_u + tl.load(matrix + 4) * of_v + tl.load(matrix + 8) * of_w
        of_y += tl.load(matrix + 1) * of_u + tl.load(matrix + 5) * of_v + tl.load(matrix + 9) * of_w
        of_z += tl.load(matrix + 2) * of_u + tl.load(matrix + 6) * of_v + tl.load(matrix + 10) * of_w
        if MATRICES:
            x, y, z = tl.where(seen, x, 0.0), tl.where(seen, y, 0.0), tl.where(seen, z, 0.0)
            at = to_matrices + ((candidate * tl.num_programs(0) + tl.program_id(0)) * num_views + view) * 12
            tl.store(at, tl.sum(of_u * x))
            tl.store(at + 1, tl.sum(of_u * y))
            tl.store(at + 2, tl.sum(of_u * z))
            tl.store(at + 3, tl.sum(of_u))
            tl.store(at + 4, tl.sum(of_v * x))
            tl.store(at + 5, tl.sum(of_v * y))
            tl.store(at + 6, tl.sum(of_v * z))
            tl.store(at + 7, tl.sum(of_v))
            tl.store(at + 8, tl.sum(of_w * x))
            tl.store(at + 9, tl.sum(of_w * y))
            tl.store(at + 10, tl.sum(of_w * z))
            tl.store(at + 11, tl.sum(of_w))
    node = first + tl.arange(0, NODES)
    there = node < num_nodes
    at = candidate * num_nodes + node
    tl.store(to_points + at * 3, of_x, mask=there)
    tl.store(to_points + at * 3 + 1, of_y, mask=there)
    tl.store(to_points + at * 3 + 2, of_z, mask=there)
    tl.store(to_volumes + at, of_volume, mask=there)


def point_drr(
    points: Tensor, volumes: Tensor, matrices: Tensor, table: Tensor, block_size: int, rows: int, cols: int
) -> Tensor:
    """Images (B, V, rows, cols); see `torchkcreg.projector.point_reference.splat_points`."""
    points, volumes, matrices, table = (t.contiguous() for t in (points, volumes, matrices, table))
    candidates, nodes, views = len(points), points.shape[1], len(matrices)
    images = points.new_zeros(candidates, views, rows, cols)
    if images.numel() and nodes:
        _splat[triton.cdiv(nodes, _NODES), candidates * views](
            points, volumes, matrices, table, images, nodes, views, table.shape[1], block_size, rows, cols,
            TAPS=table.shape[-1], PHASES=table.shape[2] - 1, NODES=_NODES,
        )  # fmt: skip
    return images


def point_drr_backward(
    grad: Tensor,
    points: Tensor,
    volumes: Tensor,
    matrices: Tensor,
    table: Tensor,
    block_size: int,
    need_volumes: bool,
    need_matrices: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients to points, volumes and matrices from a gradient to the images; empty if not needed."""
    grad, points, volumes, matrices, table = (t.contiguous() for t in (grad, points, volumes, matrices, table))
    candidates, nodes, views = len(points), points.shape[1], len(matrices)
    blocks = triton.cdiv(nodes, _NODES)
    to_points, to_volumes = torch.zeros_like(points), points.new_zeros(candidates, nodes)
    to_matrices = points.new_zeros(candidates * blocks if need_matrices else 1, views, 12)
    if grad.numel() and nodes:
        _gather[blocks, candidates](
            grad, points, volumes, matrices, table, to_points, to_volumes, to_matrices,
            nodes, views, table.shape[1], block_size, *grad.shape[-2:],
            TAPS=table.shape[-1], PHASES=table.shape[2] - 1, NODES=_NODES, MATRICES=need_matrices,
        )  # fmt: skip
    return (
        to_points,
        to_volumes.sum(0) if need_volumes else points.new_empty(0),
        to_matrices.sum(0).reshape(views, 3, 4) if need_matrices else points.new_empty(0),
    )

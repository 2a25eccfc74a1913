"""Footprints of nodes: the projected cell of a node, averaged over each pixel."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

_NODES_PER_CENTROID = 32  # enough for a block's centroid, which is needed to about a millimetre
_MAX_TAPS = 64


@dataclass(frozen=True)
class Footprint:
    """Tabulated footprints, one table for each view and each block of consecutive nodes.

    Args:
        table: Shape (V, num_blocks, R + 1, R + 1, T, T). Entry `[view, block, pv, pu]` holds the T x T pixel values
            of a node of 1 mm^3 located `pv / R` and `pu / R` of a pixel beyond the pixel of tap `T / 2 - 1`.
            The T x T taps sum to one at every phase.
        block_size: Number of consecutive nodes that share a table; the last block may be shorter.
    """

    table: Tensor
    block_size: int

    @property
    def taps(self) -> int:
        """Width T of the footprint in pixels."""
        return self.table.shape[-1]

    @property
    def phases(self) -> int:
        """Number R of tabulated sub-pixel positions along each axis."""
        return self.table.shape[2] - 1

    @property
    def num_blocks(self) -> int:
        """Number of blocks of nodes."""
        return self.table.shape[1]


@torch.no_grad()
def cell_footprint(
    points: Tensor,  # (..., N, 3)
    cell: Tensor,  # (3, 3) or (num_blocks, 3, 3)
    projection_matrices: Tensor,  # (V, 3, 4)
    *,
    block_size: int = 8192,
    phases: int = 16,
) -> Footprint:
    """Footprint of the nodes of a lattice: the projection of their cell, box-filtered by the pixel.

    Near a block's centroid the projection is approximately affine and maps the edges `a_i` of the cell to `e_i = J a_i`
    in pixels. The image of a homogeneous cell is then the box spline of `e_1, e_2, e_3`. Its average over a pixel has
    the Fourier transform `prod_i sinc(f . e_i) * sinc(f_u) sinc(f_v)` with f in cycles per pixel. Sampling
    it at multiples of `1 / T` and transforming back gives the footprint at steps of `1 / R` pixel. Smoothing with a box
    of `2 / R` pixels (Lanczos' sigma factors) avoids ringing of the truncated series where cells are much smaller than
    pixels. Footprints of cells that tile space tile the image, so there are no stripes.

    Args:
        points: Nodes in world mm, shape (..., N, 3). Positions are averaged over leading axes (candidates).
        cell: Edge vectors of a node's cell in world mm, one per row; or one such matrix per block.
        projection_matrices: World mm to homogeneous pixels, shape (V, 3, 4).
        block_size: Number of consecutive nodes that share a table. Consecutive nodes should be neighbours in space.
        phases: Number R of tabulated sub-pixel positions along each axis.

    Returns:
        The footprint, in the dtype and on the device of the points, without gradient.

    Raises:
        ValueError: Shapes or devices do not fit, or cells project to more than 64 pixels.

    >>> P = torch.tensor([[[1000.0, 0, 0, 0], [0, 1000, 0, 0], [0, 0, 1, 500]]])
    >>> footprint = cell_footprint(torch.zeros(5, 3), 0.25 * torch.eye(3), P)
    >>> footprint.table.shape
    torch.Size([1, 1, 17, 17, 4, 4])
    """
    _check(points, cell, projection_matrices, block_size, phases)
    matrices = projection_matrices.to(points)
    centroids = _block_centroids(points, block_size)
    edges = _projected_edges(centroids, cell.to(points), matrices)
    taps = _num_taps(edges, phases)
    table = _tabulate(edges.flatten(0, 1), taps, phases)
    return Footprint(table.reshape(len(matrices), len(centroids), *table.shape[1:]), block_size)


def _check(points: Tensor, cell: Tensor, matrices: Tensor, block_size: int, phases: int) -> None:
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[-2] == 0:
        raise ValueError(f"points must have shape (..., N, 3) with N > 0, got {tuple(points.shape)}")
    if matrices.dim() != 3 or matrices.shape[1:] != (3, 4):
        raise ValueError(f"projection_matrices must have shape (V, 3, 4), got {tuple(matrices.shape)}")
    if block_size < 1:
        raise ValueError(f"block_size must be positive, got {block_size}")
    if phases < 2 or phases % 2:
        raise ValueError(f"phases must be an even number, got {phases}")
    num_blocks = math.ceil(points.shape[-2] / block_size)
    if tuple(cell.shape) not in ((3, 3), (num_blocks, 3, 3)):
        raise ValueError(f"cell must have shape (3, 3) or ({num_blocks}, 3, 3), got {tuple(cell.shape)}")
    for name, tensor in (("cell", cell), ("projection_matrices", matrices)):
        if tensor.device != points.device:
            raise ValueError(f"{name} must be on the points' device {points.device}, got {tensor.device}")
    if not torch.isfinite(cell).all():
        raise ValueError("cell must be finite")


def _block_centroids(points: Tensor, block_size: int) -> Tensor:
    """Approximate centroid (num_blocks, 3) of each block, from a few of its nodes in all candidates."""
    num_nodes = points.shape[-2]
    num_samples = min(block_size, _NODES_PER_CENTROID)
    starts = torch.arange(0, num_nodes, block_size, device=points.device)
    lengths = (num_nodes - starts).clamp(max=block_size)
    steps = torch.arange(num_samples, device=points.device)
    picks = starts[:, None] + torch.div(lengths[:, None] * (2 * steps + 1), 2 * num_samples, rounding_mode="floor")
    nodes = points.index_select(-2, picks.flatten()).reshape(-1, len(starts), num_samples, 3)
    return nodes.movedim(1, 0).flatten(1, 2).nanmean(dim=1)


def _projected_edges(centroids: Tensor, cell: Tensor, matrices: Tensor) -> Tensor:
    """Cell edges in pixels (V, num_blocks, 3 edges, 2), by the Jacobian of the projection at the centroids."""
    linear, offset = matrices[:, None, :, :3], matrices[:, None, :, 3]
    pixels = (linear * centroids[:, None, :]).sum(-1) + offset
    depth = pixels[..., 2:]
    uv = pixels[..., :2] / depth
    jacobian = (linear[..., :2, :] - uv[..., None] * linear[..., 2:, :]) / depth[..., None]
    edges = cell @ jacobian.mT
    # Blocks behind the source (or with NaN) are not drawn, so their footprint does not matter.
    return torch.where((depth > 0)[..., None] & edges.isfinite(), edges, 0.0)


def _num_taps(edges: Tensor, phases: int) -> int:
    """Smallest of 4, 6, 8, 12, 16, 24, ... that contains the support of every footprint."""
    width = float(edges.abs().sum(dim=2).amax()) + 1 + 2 / phases if edges.numel() else 0.0
    taps = 4
    while taps < width:
        taps = taps * 3 // 2 if taps & (taps - 1) == 0 else taps * 4 // 3
    if taps > _MAX_TAPS:
        raise ValueError(
            f"cell must project to at most {_MAX_TAPS} pixels, got {width:.0f}: check its unit (mm) and that no points "
            "lie next to the source"
        )
    return taps


def _tabulate(edges: Tensor, taps: int, phases: int) -> Tensor:
    """Tables (n, R + 1, R + 1, T, T) of the footprints with projected edges (n, 3, 2)."""
    image = _periodic_footprint(edges, taps, phases).flatten(-2)
    table = image.index_select(-1, _tap_index(taps, phases, edges.device))
    return table.unflatten(-1, (phases + 1, phases + 1, taps, taps))


def _periodic_footprint(edges: Tensor, taps: int, phases: int) -> Tensor:
    """Footprints (n, T R, T R) at every 1 / R pixel, centred on entry 0 and repeated with a period of T pixels.

    A footprint is symmetric about its node, so its transform F is real and even. With `f_u, f_v >= 0` and
    `F' = F(f_u, -f_v)` the footprint at d is the sum of `(F + F') cos cos - (F - F') sin sin` over frequencies.
    """
    even, odd, angle_u, angle_v = _transform(taps, phases, edges.dtype, edges.device)
    signs = edges.new_tensor([[1.0, 1.0], [1.0, -1.0]])[:, None, None]
    first, second, third = (_sinc(edge, angle_u, angle_v) for edge in (signs * edges).unbind(2))
    plus, minus = first.mul_(second).mul_(third)
    half = torch.cat([(plus + minus) @ even, (minus - plus) @ odd], dim=1)
    return torch.cat([even, odd]).mT @ half


def _sinc(edge: Tensor, angle_u: Tensor, angle_v: Tensor) -> Tensor:
    """`sin(x) / x` for x = pi f . e with edges e (..., 2), shape (..., f_v, f_u)."""
    angle = edge[..., 1, None, None] * angle_v + edge[..., 0, None, None] * angle_u
    angle += 1e-20  # makes sin(x) / x one at zero and changes nothing else
    return torch.sin(angle).div_(angle)


@functools.lru_cache(maxsize=8)
def _transform(taps: int, phases: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Filtered cosine and sine transforms (frequencies, T R) along an axis; angles of sin(x) / x along u and v."""
    size = taps * phases
    frequency = torch.arange(size // 2, dtype=torch.float64, device=device) / taps
    # Pixel box, Lanczos box, and weights for half a plane: 2 where f_u > 0, and 1 / 2 where f_v = 0, as F = F' there.
    window = torch.sinc(frequency) * torch.sinc(2 * frequency / phases) / taps * math.sqrt(2)
    window[0] /= 2
    angle = 2 * math.pi * frequency[:, None] * torch.arange(size, dtype=torch.float64, device=device) / phases
    even, odd = window[:, None] * torch.cos(angle), window[:, None] * torch.sin(angle)
    along = math.pi * frequency
    return even.to(dtype), odd.to(dtype), along.to(dtype), along[:, None].to(dtype)


@functools.lru_cache(maxsize=8)
def _tap_index(taps: int, phases: int, device: torch.device) -> Tensor:
    """Indices of the table entries (pv, pu, tv, tu) in a flattened periodic footprint."""
    size = taps * phases
    phase = torch.arange(phases + 1, device=device)
    first = phases * (taps // 2 - 1 - torch.arange(taps, device=device))
    # Node minus pixel; by symmetry the same as pixel minus node.
    index = (phase[:, None] + first) % size
    return (index[:, None, :, None] * size + index[None, :, None, :]).flatten()

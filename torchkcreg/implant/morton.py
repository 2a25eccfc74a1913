"""Morton order (z-curve): neighbours in space become neighbours in memory."""

from __future__ import annotations

import torch
from torch import Tensor

_BITS = 21  # three coordinates of 21 bits fill an int64 without its sign


def morton_order(points: Tensor, cell: Tensor) -> Tensor:
    """Permutation (N,) that sorts points (N, 3) along the z-curve of a lattice with cell edges (3, 3) in rows.

    Any stretch of the sorted points is compact, so a block of them shares one footprint and one patch of the detector.
    Points of the same cell keep their order.

    Raises:
        ValueError: the points span more than 2^21 cells.

    >>> morton_order(torch.tensor([[3.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 1.5, 0.5]]), torch.eye(3)).tolist()
    [1, 2, 0]
    """
    in_cells = points.detach().double() @ torch.linalg.inv(cell.detach().double())
    # a small shift, so that a lattice of rounded coordinates does not fall on both sides of the cell faces
    indices = torch.floor(in_cells - in_cells.amin(0) + 0.25).long()
    if bool((indices >= 1 << _BITS).any()):
        raise ValueError(
            f"points must span fewer than {1 << _BITS} cells along each axis, got {indices.amax(0).tolist()}"
        )
    spread = _spread_bits(torch.arange(int(indices.max()) + 1, device=indices.device))  # a table: far fewer than points
    code = torch.zeros_like(indices[:, 0])
    for axis in range(3):
        code |= spread[indices[:, axis]] << axis
    return torch.argsort(code, stable=True)


def _spread_bits(value: Tensor) -> Tensor:
    """Bits b20 ... b1 b0 moved apart to b20 0 0 ... b1 0 0 b0."""
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        value = (value | (value << shift)) & mask
    return value

"""Pixels without a measurement, filled from their neighbours before a filter spreads them over a row."""

from __future__ import annotations

import torch
from torch import Tensor


def filled(images: Tensor, mask: Tensor) -> Tensor:
    """Images (..., rows, cols) whose masked pixels hold a mean of the nearest valid ones left, right, above and below.

    Neighbours weigh with one over their distance. So a dead column is interpolated linearly along the rows, a dead row
    along the columns; at the border the nearest value goes on. Valid pixels stay as they are.

    Args:
        images: Line integrals; what masked pixels hold, NaN included, does not matter.
        mask: Nonzero where a pixel holds a measurement, same shape.

    Raises:
        ValueError: Shapes differ, or a masked pixel has no valid one in its row and column.

    >>> row = torch.tensor([[1.0, 9.0, 9.0, 4.0, 9.0]])
    >>> filled(row, torch.tensor([[1, 0, 0, 1, 0]])).tolist()
    [[1.0, 2.0, 3.0, 4.0, 4.0]]
    """
    valid = mask != 0
    if valid.shape != images.shape:
        raise ValueError(f"mask must have the images' shape {tuple(images.shape)}, got {tuple(valid.shape)}")
    if bool(valid.all()):
        return images
    known = torch.where(valid, images, 0.0)
    total, weights = torch.zeros_like(known), torch.zeros_like(known)
    for dim in (-1, -2):
        for backwards in (False, True):
            value, distance = _nearest(known, valid, dim, backwards=backwards)
            share = torch.where(distance > 0, 1 / distance.clamp_min(1), 0.0).to(known)
            total += share * value
            weights += share
    lost = ~valid & (weights == 0)
    if bool(lost.any()):
        raise ValueError(f"{int(lost.sum())} masked pixels have no valid one in their row and column to be filled from")
    return torch.where(valid, images, total / weights.clamp_min(1e-12))


def filled_transmission(transmission: Tensor, mask: Tensor) -> Tensor:
    """Transmissions whose masked pixels are filled as line integrals, see `filled`."""
    tiny = torch.finfo(transmission.dtype).tiny
    lines = -torch.log(torch.where(mask != 0, transmission, 1.0).clamp_min(tiny))
    return torch.where(mask != 0, transmission, torch.exp(-filled(lines, mask)))


def _nearest(images: Tensor, valid: Tensor, dim: int, *, backwards: bool) -> tuple[Tensor, Tensor]:
    """The nearest valid value before (or after) each pixel along an axis, and its distance; 0 where there is none."""
    if backwards:
        value, distance = _nearest(images.flip(dim), valid.flip(dim), dim, backwards=False)
        return value.flip(dim), distance.flip(dim)
    size = images.shape[dim]
    places = torch.arange(size, device=images.device)
    places = places if dim == -1 else places[:, None]
    last = torch.where(valid, places, -1).cummax(dim).values
    value = images.gather(dim, last.clamp_min(0))
    return value, torch.where(last < 0, 0, places - last)

"""Metal artefact reduction with known components (KC-MAR): what stands behind the registered metal is interpolated."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

_LEAST_MM = 0.05  # of metal in a pixel, below which it shows its background well


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


def inpainted(line_integrals: Tensor, metal: Tensor, *, mask: Tensor | None = None, margin_px: int = 1) -> Tensor:
    """Line integrals (V, rows, cols) as if the metal were not there, interpolated across its shadow.

    The shadow is that of the registered components (after Uneri et al. 2019), not of a threshold in a volume that
    metal has spoilt, so that it is as narrow as it can be. Nothing is known of what stood behind the metal: this takes
    seconds, where KC-Rec takes minutes and keeps what the metal lets through.

    Args:
        line_integrals: Without scatter, (V, rows, cols).
        metal: Path lengths in mm of the components (M, V, rows, cols), one image a material and view.
        mask: 0 where a pixel holds no measurement.
        margin_px: By how much the shadow is widened on all sides: the system's blur.

    Raises:
        ValueError: If shapes differ, or a view shows nothing but metal.

    >>> import torch
    >>> lines = torch.full((1, 5, 5), 2.0)
    >>> lines[0, 2, 2] = 9.0
    >>> metal = torch.zeros(1, 1, 5, 5)
    >>> metal[0, 0, 2, 2] = 3.0
    >>> inpainted(lines, metal).unique().tolist()
    [2.0]
    """
    if metal.shape[1:] != line_integrals.shape:
        raise ValueError(f"metal must have shape (M, *{tuple(line_integrals.shape)}), got {tuple(metal.shape)}")
    if margin_px < 0:
        raise ValueError(f"margin_px must not be negative, got {margin_px}")
    shadow = (metal.sum(0) > _LEAST_MM).to(line_integrals)
    shadow = max_pool2d(shadow[:, None], 2 * margin_px + 1, stride=1, padding=margin_px)[:, 0] > 0
    usable = ~shadow if mask is None else ~shadow & (mask != 0)
    return filled(line_integrals, usable)

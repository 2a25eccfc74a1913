"""Shadows of metal balls in X-ray views: detection with subpixel accuracy, and tracking across the views of a scan."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

LEAST_SEEN = 0.8  # share of the views a ball must be seen in
LEAST_CORRELATION = 0.6  # of a shadow with the model of a ball's shadow
AROUND = 1.6  # radius of the compared region, in radii of the ball


def bead_shadows(
    line_integrals: Tensor, expected: Tensor, *, diameter_px: float, search_px: float = 10.0
) -> tuple[Tensor, Tensor]:
    """Positions (V, N, 2) of balls' shadows near expected positions, and their correlations (V, N).

    A plane of grey values is subtracted around each pixel, and the rest is correlated with the path length through a
    ball. The position is the maximum of the correlation, interpolated between pixels by a parabola. NaN if no
    correlation reaches 0.6, or if the maximum lies at the edge of the search region.

    Args:
        line_integrals: Line integrals (V, rows, cols).
        expected: Expected (u, v) of each ball in each view, pixels, (V, N, 2); NaN where a ball is not searched.
        diameter_px: Diameter of a shadow.
        search_px: Half width of the search region around the expected position.

    >>> rows, cols = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    >>> image = (9 - (cols - 20.4) ** 2 - (rows - 17.6) ** 2).clamp_min(0).sqrt()
    >>> found, _ = bead_shadows(image[None], torch.tensor([[[22.0, 16.0]]]), diameter_px=6.0)
    >>> [round(float(x), 1) for x in found[0, 0]]
    [20.4, 17.6]
    """
    if line_integrals.dim() != 3 or expected.shape[:1] != line_integrals.shape[:1] or expected.shape[-1] != 2:
        raise ValueError(
            "line_integrals must have shape (V, rows, cols) and expected (V, N, 2), got "
            f"{tuple(line_integrals.shape)} and {tuple(expected.shape)}"
        )
    if not diameter_px > 1 or not search_px > 0:
        raise ValueError(f"diameter_px must be above 1 and search_px positive, got {diameter_px} and {search_px}")
    positions = torch.full(expected.shape, math.nan, dtype=torch.float64)
    best = torch.zeros(expected.shape[:2], dtype=torch.float64)
    for view, image in enumerate(line_integrals.double().cpu()):
        if not bool(expected[view].isfinite().any()):
            continue
        map_ = _correlation(image, diameter_px / 2)
        for bead, (u, v) in enumerate(expected[view].tolist()):
            if math.isfinite(u) and math.isfinite(v):
                positions[view, bead], best[view, bead] = _peak(map_, u, v, search_px)
    return positions, best


def track_beads(
    line_integrals: Tensor, *, diameter_px: float, start: Tensor | None = None, search_px: float = 6.0
) -> Tensor:
    """Tracks (V, N, 2) of balls' shadows across the views of a scan, starting in the first view.

    Each shadow is searched at the linear extrapolation of its last two positions. Views must follow each other closely:
    a shadow may deviate from the extrapolation by `search_px`.

    Args:
        line_integrals: Line integrals (V, rows, cols), in the order of the gantry's angles.
        diameter_px: Diameter of a shadow.
        start: Positions (u, v) of the balls in the first view, (N, 2). If None, all that looks like a ball there is
            tracked, and tracks seen in at least four of five views are returned. Screw tips and marks do not look
            like balls from all sides.
        search_px: Half width of the search region around the expected position.

    Raises:
        ValueError: No ball is seen in at least four of five views, or a ball of `start` is lost more often.
    """
    first = _candidates(line_integrals[0], diameter_px) if start is None else torch.as_tensor(start).double()
    if first.dim() != 2 or first.shape[1] != 2:
        raise ValueError(f"start must have shape (N, 2), got {tuple(first.shape)}")
    last, step, tracks = first, torch.zeros_like(first), []
    for view in range(len(line_integrals)):
        expected = last + step
        positions, _ = bead_shadows(
            line_integrals[view : view + 1], expected[None], diameter_px=diameter_px, search_px=search_px
        )
        seen = positions[0].isfinite().all(-1, keepdim=True)
        current = torch.where(seen, positions[0], expected)
        step = torch.where(seen, current - last, step) if view else torch.zeros_like(first)
        last = current
        tracks.append(positions[0])
    result = torch.stack(tracks)
    steady = result.isfinite().all(-1).double().mean(0) >= LEAST_SEEN
    if start is not None and not bool(steady.all()):
        lost = [index for index, is_steady in enumerate(steady.tolist()) if not is_steady]
        raise ValueError(f"beads {lost} of start are lost in more than one view of five: is diameter_px right?")
    if not bool(steady.any()):
        raise ValueError(f"nothing looks like a ball of {diameter_px:g} pixels in four views of five")
    return _distinct(result[:, steady], diameter_px)


def _candidates(image: Tensor, diameter_px: float) -> Tensor:
    """Positions (N, 2) in an image that look like the shadow of a ball."""
    map_ = _correlation(image.double().cpu(), diameter_px / 2)
    around = 2 * math.ceil(diameter_px / 2) + 1
    peaks = map_ == max_pool2d(map_[None, None], around, stride=1, padding=around // 2)[0, 0]
    rows, cols = (peaks & (map_ > LEAST_CORRELATION)).nonzero().unbind(1)
    return torch.stack([cols, rows], dim=-1).double()


def _distinct(tracks: Tensor, diameter_px: float) -> Tensor:
    """The tracks without duplicates: tracks less than half a diameter apart follow the same ball."""
    distinct: list[int] = []
    for bead in range(tracks.shape[1]):
        distances = [(tracks[:, bead] - tracks[:, index]).norm(dim=-1).nanmedian() for index in distinct]
        if all(float(distance) > diameter_px / 2 for distance in distances):
            distinct.append(bead)
    return tracks[:, distinct]


def _correlation(image: Tensor, radius: float) -> Tensor:
    """Correlation (rows, cols) of each pixel's surroundings, minus a fitted plane, with a ball's shadow."""
    kernels, inside = _kernels(radius)
    padded = pad(image[None, None], [kernels.shape[-1] // 2] * 4, mode="replicate")
    along, *planes = conv2d(padded, kernels)[0]
    power = conv2d(padded.square(), inside)[0, 0] - sum(part.square() for part in planes)
    return along / power.clamp_min(1e-12).sqrt()


@lru_cache(maxsize=4)
def _kernels(radius: float) -> tuple[Tensor, Tensor]:
    """Orthonormal kernels (4, 1, n, n) of a ball's shadow and a plane's three terms, and their support (1, 1, n, n)."""
    reach = math.ceil(AROUND * radius)
    steps = torch.arange(-reach, reach + 1, dtype=torch.float64)
    down, across = torch.meshgrid(steps, steps, indexing="ij")
    inside = down.hypot(across) <= AROUND * radius + 0.5
    fine = torch.arange(-3, 4, dtype=torch.float64) / 7  # parts of a pixel
    chord = torch.zeros_like(down)
    for i in fine:
        for j in fine:
            chord += (radius**2 - (down + i) ** 2 - (across + j) ** 2).clamp_min(0).sqrt()
    plane = torch.stack([torch.ones_like(down), down, across])[:, inside]  # (3, n), orthogonal
    plane = plane / plane.norm(dim=1, keepdim=True)
    shape = chord[inside]
    shape = shape - plane.mT @ (plane @ shape)
    kernels = torch.zeros(4, 1, *down.shape, dtype=torch.float64)
    kernels[0, 0][inside] = shape / shape.norm()
    for k in range(3):
        kernels[k + 1, 0][inside] = plane[k]
    return kernels, inside[None, None].double()


def _peak(map_: Tensor, u: float, v: float, search: float) -> tuple[Tensor, float]:
    """Position (u, v) and value of the maximum near a position; NaN and 0 if there is none."""
    nothing = torch.full((2,), math.nan, dtype=torch.float64), 0.0
    rows, cols = map_.shape
    top, left = max(1, math.ceil(v - search)), max(1, math.ceil(u - search))
    bottom, right = min(rows - 1, math.floor(v + search) + 1), min(cols - 1, math.floor(u + search) + 1)
    if top >= bottom or left >= right:
        return nothing
    window = map_[top:bottom, left:right]
    row, col = divmod(int(window.argmax()), window.shape[1])
    height = float(window[row, col])
    i, j = row + top, col + left
    patch = map_[i - 1 : i + 2, j - 1 : j + 2]
    if height < LEAST_CORRELATION or float(patch.max()) > height:
        return nothing
    offsets = []
    for before, here, after in (patch[1].tolist(), patch[:, 1].tolist()):
        curvature = before - 2 * here + after
        offsets.append(0.0 if curvature >= 0 else 0.5 * (before - after) / curvature)
    return torch.tensor([j + offsets[0], i + offsets[1]], dtype=torch.float64), height

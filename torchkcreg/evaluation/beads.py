"""Metal balls in a reconstructed volume, to a small part of a voxel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label
from scipy.optimize import least_squares
from scipy.special import erf
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

WINDOW_DIAMETERS = 0.6  # how far beyond a ball its surroundings are fitted with it
LARGEST_EXTENT = 2.2  # of a candidate, in diameters and blurs: longer things are no balls
LARGEST_BLUR = 0.5  # standard deviation, in diameters
LEAST_CORRELATION = 0.8
ISOLATION = 0.5  # share of its peak that a thing's surroundings must stay below


@dataclass(frozen=True)
class Beads:
    """Balls found in a volume, the best first.

    Attributes:
        centers: (N, 3) in world mm.
        correlations: (N,) of the volume around each with the fitted ball.
        contrasts: (N,) of each ball against its surroundings, in the volume's unit.
    """

    centers: Tensor
    correlations: Tensor
    contrasts: Tensor


def find_beads(
    volume: Tensor,
    grid: VolumeGrid,
    *,
    diameter_mm: float = 2.0,
    num_beads: int | None = None,
    threshold: float | None = None,
) -> Beads:
    """Centres of metal balls in a volume (D, H, W), by fitting a blurred ball to each thing of the right size.

    Things are what exceeds a threshold and hangs together; plates and screws are too long, noise is no ball. The fit of
    centre, contrast, surroundings and blur to the voxels around leaves an error of a few hundredths of a millimetre.

    Args:
        volume: attenuation; FDK of the unloaded or the loaded scan.
        grid: its voxels, at most half a ball apart.
        diameter_mm: of the balls.
        num_beads: how many to return, the best; all that look like balls if None.
        threshold: of what may be metal; if None, several between soft tissue and the brightest voxels are tried.

    Raises:
        ValueError: the shapes differ, the voxels are larger than the balls' radius, or fewer balls than asked for.

    >>> grid = VolumeGrid.centered((24, 24, 24), 0.5)
    >>> offset = (grid.points() - torch.tensor([0.3, -0.2, 0.1])).norm(dim=-1)
    >>> volume = ((1.25 - offset) / 0.5).clamp(0, 1)
    >>> find_beads(volume, grid).centers.round(decimals=1).tolist()
    [[0.3, -0.2, 0.1]]
    """
    if tuple(volume.shape) != tuple(grid.shape):
        raise ValueError(f"volume must have the grid's shape {tuple(grid.shape)}, got {tuple(volume.shape)}")
    if not diameter_mm > 0 or max(grid.spacing) > diameter_mm / 2:
        raise ValueError(f"voxels must be at most half a ball of {diameter_mm} mm apart, got {grid.spacing}")
    values = volume.detach().cpu().double().numpy()
    found: list[tuple[float, float, NDArray]] = []
    for level in [threshold] if threshold is not None else _levels(values, grid, diameter_mm):
        for candidate in _candidates(values, grid, level, diameter_mm):
            if all(np.linalg.norm(candidate - center) > diameter_mm / 2 for _, _, center in found):
                fit = fit_bead(values, grid, candidate, diameter_mm)
                if fit is not None and all(np.linalg.norm(fit[2] - c) > diameter_mm / 2 for _, _, c in found):
                    found.append(fit)
    found.sort(key=lambda fit: -fit[0])
    if num_beads is not None:
        if len(found) < num_beads:
            raise ValueError(f"only {len(found)} of {num_beads} beads were found")
        found = found[:num_beads]
    columns = list(zip(*found)) or [(), (), ()]
    centers = torch.from_numpy(np.array(columns[2], dtype=np.float64).reshape(-1, 3))
    return Beads(centers, torch.tensor(columns[0]).double(), torch.tensor(columns[1]).double())


def _levels(values: NDArray, grid: VolumeGrid, diameter_mm: float) -> list[float]:
    """Thresholds to try, falling: shares of the brightest part as large as a few balls."""
    ball = max(1, round(math.pi / 6 * diameter_mm**3 / grid.voxel_volume))
    count = min(values.size, 4 * ball)
    bright = float(np.partition(values.ravel(), -count)[-count:].mean())
    return [share * bright for share in (0.7, 0.5, 0.35, 0.25, 0.18)]


def _candidates(values: NDArray, grid: VolumeGrid, level: float, diameter_mm: float) -> list[NDArray]:
    """World positions of things above a level that are about as large as a ball in each direction."""
    labels, _ = label(values > level)
    largest = [LARGEST_EXTENT * diameter_mm / step + 1 for step in reversed(grid.spacing)]
    to_world = grid.voxel_to_world.numpy()
    result = []
    for number, box in enumerate(find_objects(labels), start=1):
        if any(part.stop - part.start > limit for part, limit in zip(box, largest)):
            continue
        weights = np.where(labels[box] == number, values[box], 0.0)
        if (weights > 0).sum() * grid.voxel_volume < 0.05 * math.pi / 6 * diameter_mm**3:
            continue
        index = [
            float((weights.sum(tuple(a for a in range(3) if a != axis)) * np.arange(n)).sum() / weights.sum())
            for axis, n in enumerate(weights.shape)
        ]
        if not _is_alone(values, box, [diameter_mm / step for step in reversed(grid.spacing)]):
            continue
        kji = np.array(index) + [part.start for part in box]
        result.append(to_world[:3, :3] @ kji[::-1] + to_world[:3, 3])
    return result


def _is_alone(values: NDArray, box: tuple[slice, ...], diameter: list[float]) -> bool:
    """Whether what surrounds a thing, half a diameter to one away, is mostly much darker than its peak."""
    wide = tuple(
        slice(max(0, part.start - math.ceil(d)), min(n, part.stop + math.ceil(d)))
        for part, n, d in zip(box, values.shape, diameter)
    )
    around = values[wide].copy()
    peak = around[tuple(slice(p.start - w.start, p.stop - w.start) for p, w in zip(box, wide))].max()
    core = tuple(
        slice(max(0, p.start - w.start - math.ceil(d / 2)), p.stop - w.start + math.ceil(d / 2))
        for p, w, d in zip(box, wide, diameter)
    )
    around[core] = np.nan
    rim = around[np.isfinite(around)]
    return len(rim) > 0 and float(np.quantile(rim, 0.9)) < ISOLATION * peak


def fit_bead(
    values: NDArray, grid: VolumeGrid, start: NDArray, diameter_mm: float
) -> tuple[float, float, NDArray] | None:
    """Correlation, contrast and centre of the blurred ball that fits best near a place; None where none does.

    A plane of grey values lies under the ball, for the shading that metal nearby leaves.
    """
    to_voxel = grid.world_to_voxel.numpy()
    middle = to_voxel[:3, :3] @ start + to_voxel[:3, 3]
    half = diameter_mm * (0.5 + WINDOW_DIAMETERS)
    low = [max(0, math.floor(m - half / s)) for m, s in zip(middle, grid.spacing)]
    high = [min(n, math.ceil(m + half / s) + 1) for m, s, n in zip(middle, grid.spacing, reversed(grid.shape))]
    if any(b - a < 4 for a, b in zip(low, high)):
        return None
    k, j, i = np.meshgrid(*(np.arange(low[a], high[a]) for a in (2, 1, 0)), indexing="ij")
    to_world = grid.voxel_to_world.numpy()
    points = np.stack([i, j, k], axis=-1).reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    observed = values[low[2] : high[2], low[1] : high[1], low[0] : high[0]].ravel()
    near = np.linalg.norm(points - start, axis=1) <= half
    points, observed = points[near], observed[near]

    def design(x: NDArray) -> NDArray:
        distance = np.linalg.norm(points - x[:3], axis=1)
        return np.column_stack(
            [blurred_ball(distance, diameter_mm / 2, math.exp(x[3])), np.ones(len(points)), points - start]
        )

    def residual(x: NDArray) -> NDArray:
        columns = design(x)
        return observed - columns @ np.linalg.lstsq(columns, observed, rcond=None)[0]

    x0 = np.array([*start, math.log(0.25 * diameter_mm)])
    bounds = (
        np.array([*(start - diameter_mm), math.log(0.02 * diameter_mm)]),
        np.array([*(start + diameter_mm), math.log(LARGEST_BLUR * diameter_mm)]),
    )
    best = least_squares(residual, x0, bounds=bounds, x_scale=[0.1, 0.1, 0.1, 0.3])
    columns = design(best.x)
    coefficients = np.linalg.lstsq(columns, observed, rcond=None)[0]
    shape = columns[:, 0] - columns[:, 0].mean()
    flat = observed - columns[:, 1:] @ coefficients[1:]
    correlation = float(np.corrcoef(shape, flat)[0, 1]) if np.ptp(shape) > 0 else 0.0
    at_bound = best.x[3] > bounds[1][3] - 1e-3  # a bump wider than a blurred ball
    if at_bound or coefficients[0] <= 0 or not correlation > LEAST_CORRELATION:
        return None
    return correlation, float(coefficients[0]), best.x[:3]


def blurred_ball(distance: NDArray, radius: float, sigma: float) -> NDArray:
    """A ball of height 1 after a Gaussian blur, at distances from its centre; all lengths in mm."""
    d = np.maximum(distance, 1e-6 * radius)
    inside, outside = (radius - d) / sigma, (radius + d) / sigma
    steps = 0.5 * (erf(inside / math.sqrt(2)) + erf(outside / math.sqrt(2)))
    return steps - sigma / (d * math.sqrt(2 * math.pi)) * (np.exp(-(inside**2) / 2) - np.exp(-(outside**2) / 2))

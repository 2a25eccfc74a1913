"""Metal balls in a reconstructed volume: detection, and centres with subvoxel accuracy."""

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

WINDOW_DIAMETERS = 0.6  # margin around a ball that is fitted with it
LARGEST_EXTENT = 2.2  # of a candidate, in diameters, with blur: longer objects are not balls
LARGEST_BLUR = 0.5  # standard deviation, in diameters
LEAST_CORRELATION = 0.8
ISOLATION = 0.5  # an object's surroundings must stay below this share of its peak


@dataclass(frozen=True)
class Beads:
    """Balls found in a volume, highest correlation first.

    Attributes:
        centers: Centres (N, 3), world mm.
        correlations: Correlations (N,) of the volume around each ball with the fitted ball.
        contrasts: Contrasts (N,) of the balls to their surroundings, in the volume's unit.
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
    """Centres of metal balls in a volume (D, H, W), by fitting a blurred ball to each object of the right size.

    Objects are connected voxels above a threshold. Plates and screws are too long, and noise does not fit a ball.
    Centre, contrast, background and blur are fitted to the voxels around each object; the error of the centre is a few
    hundredths of a millimetre.

    Args:
        volume: Attenuation, such as the FDK of the unloaded or the loaded scan.
        grid: The volume's voxels, at most half a ball's diameter apart.
        diameter_mm: Diameter of the balls.
        num_beads: Number of balls to return, best first; all that look like balls if None.
        threshold: Smallest attenuation of metal; if None, several fractions of the brightest voxels' mean are tried.

    Raises:
        ValueError: The shapes differ, the voxels are larger than the balls' radius, or fewer than `num_beads` balls
            are found.

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
    fits: list[tuple[float, float, NDArray]] = []
    for level in [threshold] if threshold is not None else _levels(values, grid, diameter_mm):
        for candidate in _candidates(values, grid, level, diameter_mm):
            if all(np.linalg.norm(candidate - center) > diameter_mm / 2 for _, _, center in fits):
                fit = fit_bead(values, grid, candidate, diameter_mm)
                if fit is not None and all(np.linalg.norm(fit[2] - c) > diameter_mm / 2 for _, _, c in fits):
                    fits.append(fit)
    fits.sort(key=lambda fit: -fit[0])
    if num_beads is not None:
        if len(fits) < num_beads:
            raise ValueError(f"only {len(fits)} of {num_beads} beads were found")
        fits = fits[:num_beads]
    columns = list(zip(*fits)) or [(), (), ()]
    centers = torch.from_numpy(np.array(columns[2], dtype=np.float64).reshape(-1, 3))
    return Beads(centers, torch.tensor(columns[0]).double(), torch.tensor(columns[1]).double())


def _levels(values: NDArray, grid: VolumeGrid, diameter_mm: float) -> list[float]:
    """Falling thresholds to try: shares of the mean of the brightest voxels, as many as fill four balls."""
    ball = max(1, round(math.pi / 6 * diameter_mm**3 / grid.voxel_volume))
    count = min(values.size, 4 * ball)
    bright = float(np.partition(values.ravel(), -count)[-count:].mean())
    return [share * bright for share in (0.7, 0.5, 0.35, 0.25, 0.18)]


def _candidates(values: NDArray, grid: VolumeGrid, level: float, diameter_mm: float) -> list[NDArray]:
    """World positions of objects above a level that are about as large as a ball in each direction."""
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
    """True if the surroundings of an object, 0.5 to 1 diameter away, are mostly much darker than its peak."""
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
    """Correlation, contrast and centre of the blurred ball that fits best near a position; None if none fits.

    The background is a linear function of position, to account for shading by metal nearby.
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
    at_bound = best.x[3] > bounds[1][3] - 1e-3  # wider than a blurred ball
    if at_bound or coefficients[0] <= 0 or not correlation > LEAST_CORRELATION:
        return None
    return correlation, float(coefficients[0]), best.x[:3]


def blurred_ball(distance: NDArray, radius: float, sigma: float) -> NDArray:
    """Values of a ball of height 1 after a Gaussian blur, at distances from its centre; all lengths in mm."""
    d = np.maximum(distance, 1e-6 * radius)
    inside, outside = (radius - d) / sigma, (radius + d) / sigma
    steps = 0.5 * (erf(inside / math.sqrt(2)) + erf(outside / math.sqrt(2)))
    return steps - sigma / (d * math.sqrt(2 * math.pi)) * (np.exp(-(inside**2) / 2) - np.exp(-(outside**2) / 2))

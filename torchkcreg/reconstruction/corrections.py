"""Corrections of measured transmissions before the logarithm: scatter and glare, and the floor of the logarithm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from torchkcreg.physics import gaussian_blur

SMOOTH_NODES = 6  # pixels a standard deviation that images are reduced to: a veil is smooth
ITERATIONS = 40
AIR_TOLERANCE = 0.03
FEWEST_AIR = 50
AIR_WITHIN_MM = 20.0  # on the detector, of its left and right border
SHADOW = 0.3  # transmission of metal below which a pixel tells of scatter
FIT_VIEWS = 20
FIT_COLUMNS = 24
SIGMAS_MM = (10.0, 20.0, 30.0, 45.0, 65.0, 100.0)  # where the fit looks first


@dataclass(frozen=True)
class Veil:
    """A broad, smooth share of the primary image that lies over it: scatter, or the detector's glare.

    ``measured = primary + fraction * G primary`` with G a Gaussian blur; glare, which takes from the primary what it
    gives, is the same up to the open beam's normalisation.

    Attributes:
        fraction: of the primary.
        sigma_mm: standard deviation of the blur on the detector, mm.

    Raises:
        ValueError: a negative fraction, one of 1 or more, or a blur that is not positive.
    """

    fraction: float
    sigma_mm: float = 40.0

    def __post_init__(self) -> None:
        if not 0 <= self.fraction < 1:
            raise ValueError(f"fraction of the veil must be between 0 and 1, got {self.fraction}")
        if not (math.isfinite(self.sigma_mm) and self.sigma_mm > 0):
            raise ValueError(f"sigma_mm of the veil must be positive, got {self.sigma_mm}")


def veil_image(transmission: Tensor, veil: Veil, pixel_spacing: Sequence[float]) -> Tensor:
    """What a veil adds to each pixel, (..., rows, cols), of measured transmissions I / I0.

    Solves ``S = f G (I - S)`` by fixed-point iteration on images reduced to what the blur leaves of them.

    Args:
        transmission: measured intensity in units of the open beam, (..., rows, cols).
        veil: its share and breadth.
        pixel_spacing: (dv, du), mm.

    >>> flat = torch.full((1, 32, 32), 1.2)
    >>> round(float(veil_image(flat, Veil(0.2), (4.0, 4.0))[0, 16, 16]), 4)
    0.2
    """
    if veil.fraction == 0:
        return torch.zeros_like(transmission)
    rows, cols = transmission.shape[-2:]
    step = max(1, min(int(veil.sigma_mm / max(pixel_spacing) / SMOOTH_NODES), rows // 4, cols // 4))
    flat = transmission.reshape(-1, 1, rows, cols)
    reduced = avg_pool2d(flat, step, ceil_mode=True, count_include_pad=False)
    pitch = step * math.sqrt(pixel_spacing[0] * pixel_spacing[1])
    smooth = _fixed_point(reduced, veil.fraction, veil.sigma_mm / pitch, pitch)
    if step == 1:
        return smooth.reshape(transmission.shape)
    covered = (reduced.shape[-2] * step, reduced.shape[-1] * step)
    fine = interpolate(smooth, size=covered, mode="bilinear", align_corners=False)
    return fine[..., :rows, :cols].reshape(transmission.shape)


def _fixed_point(measured: Tensor, fraction: float, sigma_px: float, pitch: float) -> Tensor:
    """The veil (n, 1, rows, cols) of images with pixels of a pitch in mm.

    Above and below, the limb goes on; to the left and right of the detector there is air, if not at once: the primary
    rises to 1 there over `AIR_WITHIN_MM`.
    """
    veil = measured * (fraction / (1 + fraction))
    extra = max(1, min(math.ceil(2.5 * sigma_px), 4 * measured.shape[-1]))
    steps = torch.arange(1, extra + 1, dtype=measured.dtype, device=measured.device)
    rise = 0.5 - 0.5 * torch.cos(math.pi * (steps * pitch / AIR_WITHIN_MM).clamp_max(1))
    for _ in range(ITERATIONS):
        primary = measured - veil
        left, right = primary[..., :1], primary[..., -1:]
        sides = [left + (1 - left) * rise.flip(0), primary, right + (1 - right) * rise]
        last, veil = veil, fraction * gaussian_blur(torch.cat(sides, -1), sigma_px)[..., extra:-extra]
        if float((veil - last).abs().max()) < 1e-6:
            break
    return veil


def fit_veil(transmission: Tensor, pixel_spacing: Sequence[float], *, mask: Tensor | None = None) -> Veil:
    """The veil that makes the air around the object come out as the open beam.

    Where nothing stands in the beam the primary is 1, and what is measured beyond that is the veil: it falls towards
    the object's shadow, and how it does tells share and breadth. Least squares over the pixels of air, which are chosen
    anew with each estimate.

    Args:
        transmission: measured intensity in units of the open beam without a veil, (V, rows, cols).
        pixel_spacing: (dv, du), mm.
        mask: 0 where a pixel holds no measurement, saturated ones for instance.

    Raises:
        ValueError: too few pixels show air to tell.
    """
    views = np.unique(np.linspace(0, len(transmission) - 1, FIT_VIEWS).round().astype(int)).tolist()
    images = transmission[views][:, None].float()
    valid = torch.ones_like(images) if mask is None else mask[views][:, None].to(images)
    step = max(1, images.shape[-1] // FIT_COLUMNS)
    measured = avg_pool2d(images, step)
    valid = avg_pool2d(valid, step) > 0.999
    pitch = step * math.sqrt(pixel_spacing[0] * pixel_spacing[1])
    air = valid & (measured > 1 - AIR_TOLERANCE)
    for attempt in range(4):
        if int(air.sum()) < FEWEST_AIR:
            raise ValueError(f"only {int(air.sum())} pixels show air, too few to fit the scatter: give its fraction")
        if attempt == 0:  # the object's rims, not yet told from air, make local minima: look everywhere first
            candidates = [_best_fraction(sigma, measured, air, pitch) for sigma in SIGMAS_MM]
            start = min(candidates, key=lambda x: _air_misfit(x, measured, air, pitch))
        start = minimize(_air_misfit, start, args=(measured, air, pitch), method="Nelder-Mead", tol=1e-4).x
        primary = measured - _fixed_point(measured, *_parameters(start, pitch), pitch)
        air = valid & ((primary - 1).abs() < AIR_TOLERANCE * (2 if attempt == 0 else 1))
    fraction, sigma_px = _parameters(start, pitch)
    return Veil(fraction, sigma_px * pitch)


def _best_fraction(sigma_mm: float, measured: Tensor, air: Tensor, pitch: float) -> np.ndarray:
    log_sigma = math.log(sigma_mm)  # no cap on a pixel's misfit here: it would leave plateaus
    fit = minimize_scalar(
        lambda f: _air_misfit(np.array([f, log_sigma]), measured, air, pitch, math.inf),
        bounds=(0, 0.95),
        method="bounded",
    )
    return np.array([float(fit.x), log_sigma])


def _parameters(x: np.ndarray, pitch: float) -> tuple[float, float]:
    return float(np.clip(x[0], 0.0, 0.95)), float(np.exp(np.clip(x[1], math.log(5.0), math.log(300.0)))) / pitch


def _air_misfit(x: np.ndarray, measured: Tensor, air: Tensor, pitch: float, cap: float = 0.1) -> float:
    primary = measured - _fixed_point(measured, *_parameters(x, pitch), pitch)
    return float((primary - 1)[air].abs().clamp_max(cap).mean())


def refined_scatter(
    transmission: Tensor,
    scatter: Tensor,
    predicted: Tensor,
    metal: Tensor,
    pixel_spacing: Sequence[float],
    *,
    sigma_mm: float = 10.0,
) -> Tensor:
    """The scatter corrected in the shadow of known metal, where nearly all that arrives is scatter.

    What is measured beyond the primary that implant and background let through is averaged over Gaussian windows, each
    pixel weighing the less the more primary it has, and added; away from metal nothing changes.

    Args:
        transmission: measured, in units of the open beam, (V, rows, cols).
        scatter: estimate so far, same shape.
        predicted: primary that a first reconstruction and the known components predict, same shape.
        metal: transmission of the known components alone, same shape.
        pixel_spacing: (dv, du), mm.
        sigma_mm: of the windows, on the detector.
    """
    noise, share = 2e-3, 0.05  # transmission: what noise leaves of a pixel, and how well the primary is known
    weights = (metal < SHADOW) * noise**2 / (noise**2 + (share * predicted) ** 2)
    sigma = sigma_mm / math.sqrt(pixel_spacing[0] * pixel_spacing[1])
    excess = gaussian_blur(weights * (transmission - scatter - predicted), sigma)
    return scatter + excess / (gaussian_blur(weights, sigma) + 0.02)


def floored_line_integrals(primary: Tensor, *, floor: float = 1e-3) -> Tensor:
    """Line integrals ``-ln max(primary, floor)`` of transmissions; finite whatever the noise did.

    Args:
        primary: transmission without scatter, in units of the open beam.
        floor: smallest transmission taken at its word. A pixel there weighs next to nothing, see `statistical_weights`.

    Raises:
        ValueError: a floor that is not positive.
    """
    if not floor > 0:
        raise ValueError(f"floor must be positive, got {floor}")
    return -primary.clamp_min(floor).log()

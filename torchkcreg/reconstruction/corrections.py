"""Corrections of measured transmissions before the logarithm: scatter and glare, and the floor of the logarithm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchkcreg.physics import Veil, gaussian_blur, veil_image
from torchkcreg.physics.scatter import fixed_point_veil

AIR_TOLERANCE = 0.03
FEWEST_AIR = 50
SHADOW = 0.3  # transmission of metal below which a pixel tells of scatter
FIT_VIEWS = 20
FIT_COLUMNS = 24
SIGMAS_MM = (10.0, 20.0, 30.0, 45.0, 65.0, 100.0)  # where the fit looks first


def scatter_image(transmission: Tensor, scatter: Veil | Tensor | None, pixel_spacing: Sequence[float]) -> Tensor:
    """Scatter in units of the open beam, of the transmission's shape, however it is told; zeros where there is none."""
    if isinstance(scatter, Veil):
        return veil_image(transmission, scatter, pixel_spacing)
    return torch.zeros_like(transmission) if scatter is None else scatter


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
        primary = measured - fixed_point_veil(measured, *_parameters(start, pitch), pitch)
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
    primary = measured - fixed_point_veil(measured, *_parameters(x, pitch), pitch)
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

"""Corrections of measured transmissions before the logarithm: scatter, glare and a floor for the logarithm."""

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
SHADOW = 0.3  # below this transmission of the metal a pixel is used to estimate scatter
FIT_VIEWS = 20
FIT_COLUMNS = 24
SIGMAS_MM = (10.0, 20.0, 30.0, 45.0, 65.0, 100.0)  # starting values of the fit


def scatter_image(transmission: Tensor, scatter: Veil | Tensor | None, pixel_spacing: Sequence[float]) -> Tensor:
    """Scatter image in units of the open beam, from a veil or an image, in the transmission's shape; zeros if None."""
    if isinstance(scatter, Veil):
        return veil_image(transmission, scatter, pixel_spacing)
    return torch.zeros_like(transmission) if scatter is None else scatter


def fit_veil(transmission: Tensor, pixel_spacing: Sequence[float], *, mask: Tensor | None = None) -> Veil:
    """Fit the veil so that the air around the object has a primary transmission of 1.

    In air the primary is 1 and the rest of the signal is the veil. It falls off towards the object's shadow; this
    fall-off determines the veil's fraction and width. The fit minimises the capped mean absolute error over the air
    pixels, which are selected again after each estimate.

    Args:
        transmission: Measured intensity in units of the open beam without veil, (V, rows, cols).
        pixel_spacing: (dv, du), mm.
        mask: 0 where a pixel holds no measurement, for example because it is saturated.

    Raises:
        ValueError: If too few pixels show air.
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
        if attempt == 0:  # object edges still counted as air cause local minima, so start from a grid search
            candidates = [_best_fraction(sigma, measured, air, pitch) for sigma in SIGMAS_MM]
            start = min(candidates, key=lambda x: _air_misfit(x, measured, air, pitch))
        start = minimize(_air_misfit, start, args=(measured, air, pitch), method="Nelder-Mead", tol=1e-4).x
        primary = measured - fixed_point_veil(measured, *_parameters(start, pitch), pitch)
        air = valid & ((primary - 1).abs() < AIR_TOLERANCE * (2 if attempt == 0 else 1))
    fraction, sigma_px = _parameters(start, pitch)
    return Veil(fraction, sigma_px * pitch)


def _best_fraction(sigma_mm: float, measured: Tensor, air: Tensor, pitch: float) -> np.ndarray:
    log_sigma = math.log(sigma_mm)  # no cap on a pixel's misfit here: it would create plateaus
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
    """Scatter corrected in the shadow of known metal, where nearly all of the signal is scatter.

    The excess of the measured signal over the predicted primary and scatter is averaged over Gaussian windows and added
    to the scatter. Pixels with more primary have lower weight. Away from metal nothing changes.

    Args:
        transmission: Measured transmission in units of the open beam, (V, rows, cols).
        scatter: Current estimate, same shape.
        predicted: Primary predicted by a first reconstruction and the known components, same shape.
        metal: Transmission of the known components alone, same shape.
        pixel_spacing: (dv, du), mm.
        sigma_mm: Standard deviation of the windows on the detector, mm.
    """
    noise, share = 2e-3, 0.05  # transmission noise, and relative error of the predicted primary
    weights = (metal < SHADOW) * noise**2 / (noise**2 + (share * predicted) ** 2)
    sigma = sigma_mm / math.sqrt(pixel_spacing[0] * pixel_spacing[1])
    excess = gaussian_blur(weights * (transmission - scatter - predicted), sigma)
    return scatter + excess / (gaussian_blur(weights, sigma) + 0.02)


def floored_line_integrals(primary: Tensor, *, floor: float = 1e-3) -> Tensor:
    """Line integrals `-ln max(primary, floor)` of transmissions; finite even for noisy pixels.

    Args:
        primary: Transmission without scatter, in units of the open beam.
        floor: Smallest transmission used; lower values are raised to it. Such pixels have almost no weight, see
            `statistical_weights`.

    Raises:
        ValueError: If the floor is not positive.
    """
    if not floor > 0:
        raise ValueError(f"floor must be positive, got {floor}")
    return -primary.clamp_min(floor).log()

"""Broad scatter in radiographs.

Either two scatter images computed from the measurement, whose levels a registration estimates, or a veil: a share of
the blurred primary image, fitted to the air around an object and subtracted from projections.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from .blur import gaussian_blur

_AIR_WITHIN_MM = 20.0  # on the detector, beyond its left and right border
_ITERATIONS = 40
_SMOOTH_NODES = 6  # images are reduced to this many pixels per standard deviation, since a veil is smooth


def scatter_shapes(transmission: Tensor, mask: Tensor, sigma_px: float) -> Tensor:
    """Spatial distributions p and q of two kinds of scatter over the detector, shape (2, V, rows, cols).

    Single forward scatter is proportional to the transmitted beam, `p = G I` (Sun & Star-Lack 2010). Scatter from the
    side depends on the intensity removed on the way, `q = G (-I ln I)` (Ohnesorge et al. 1999). Across a limb that is
    surrounded by open beam, p falls where q rises.

    Args:
        transmission: Measured transmission I, shape (V, rows, cols).
        mask: Weight of each pixel, same shape.
        sigma_px: Width of the Gaussian G, pixels.
    """
    passed = transmission.clamp(0, 1)
    sources = torch.stack([transmission, -torch.xlogy(passed, passed)])
    return gaussian_blur(sources * mask, sigma_px) / gaussian_blur(mask, sigma_px).clamp_min(1e-3)


def scattered_signal(levels: Tensor, shapes: Tensor | None) -> Tensor:
    """Scatter `s p + r q` of candidates, in units of the open beam; broadcasts to (K, V, rows, cols).

    Args:
        levels: Levels s and r, shape (K, 2).
        shapes: Distributions p and q, shape (2, V, rows, cols). None: p is 1 everywhere and q is 0.
    """
    if shapes is None:
        return levels[:, 0, None, None, None]
    return torch.einsum("ks,svij->kvij", levels.to(shapes), shapes)


@dataclass(frozen=True)
class Veil:
    """Broad, smooth addition to the primary image, proportional to it: scatter or detector glare.

    `measured = primary + fraction * G primary` with G a Gaussian blur. Glare takes from the primary what it
    adds elsewhere, which is the same up to the open beam's normalisation.

    Attributes:
        fraction: Share of the primary.
        sigma_mm: Standard deviation of the blur on the detector, mm.

    Raises:
        ValueError: If the fraction is negative or at least 1, or the blur is not positive.
    """

    fraction: float
    sigma_mm: float = 40.0

    def __post_init__(self) -> None:
        if not 0 <= self.fraction < 1:
            raise ValueError(f"fraction of the veil must be between 0 and 1, got {self.fraction}")
        if not (math.isfinite(self.sigma_mm) and self.sigma_mm > 0):
            raise ValueError(f"sigma_mm of the veil must be positive, got {self.sigma_mm}")


def veil_image(transmission: Tensor, veil: Veil, pixel_spacing: Sequence[float]) -> Tensor:
    """Veil signal in each pixel, (..., rows, cols), of measured transmissions I / I0.

    Solves `S = f G (I - S)` by fixed-point iteration, on images reduced to the resolution that the blur leaves.

    Args:
        transmission: Measured intensity in units of the open beam, (..., rows, cols).
        veil: Its share and breadth.
        pixel_spacing: Pixel spacing (dv, du), mm.

    >>> flat = torch.full((1, 32, 32), 1.2)
    >>> round(float(veil_image(flat, Veil(0.2), (4.0, 4.0))[0, 16, 16]), 4)
    0.2
    """
    if veil.fraction == 0:
        return torch.zeros_like(transmission)
    rows, cols = transmission.shape[-2:]
    step = max(1, min(int(veil.sigma_mm / max(pixel_spacing) / _SMOOTH_NODES), rows // 4, cols // 4))
    flat = transmission.reshape(-1, 1, rows, cols)
    reduced = avg_pool2d(flat, step, ceil_mode=True, count_include_pad=False)
    pitch = step * math.sqrt(pixel_spacing[0] * pixel_spacing[1])
    smooth = fixed_point_veil(reduced, veil.fraction, veil.sigma_mm / pitch, pitch)
    if step == 1:
        return smooth.reshape(transmission.shape)
    covered = (reduced.shape[-2] * step, reduced.shape[-1] * step)
    fine = interpolate(smooth, size=covered, mode="bilinear", align_corners=False)
    return fine[..., :rows, :cols].reshape(transmission.shape)


def fixed_point_veil(measured: Tensor, fraction: float, sigma_px: float, pitch: float) -> Tensor:
    """Veil (n, 1, rows, cols) of images whose pixels are `pitch` mm wide.

    Above and below the detector the limb is assumed to continue. To the left and right air is assumed: there the
    primary rises to 1 over `_AIR_WITHIN_MM`.
    """
    veil = measured * (fraction / (1 + fraction))
    extra = max(1, min(math.ceil(2.5 * sigma_px), 4 * measured.shape[-1]))
    steps = torch.arange(1, extra + 1, dtype=measured.dtype, device=measured.device)
    rise = 0.5 - 0.5 * torch.cos(math.pi * (steps * pitch / _AIR_WITHIN_MM).clamp_max(1))
    for _ in range(_ITERATIONS):
        primary = measured - veil
        left, right = primary[..., :1], primary[..., -1:]
        sides = [left + (1 - left) * rise.flip(0), primary, right + (1 - right) * rise]
        last, veil = veil, fraction * gaussian_blur(torch.cat(sides, -1), sigma_px)[..., extra:-extra]
        if float((veil - last).abs().max()) < 1e-6:
            break
    return veil

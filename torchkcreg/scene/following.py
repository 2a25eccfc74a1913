"""Background refitted to every candidate, so that it does not hold the implant where it was estimated."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from torchkcreg.physics import gaussian_blur, scattered_signal

PIXELS_OF_SIGMA = 0.4  # a pixel is no larger than this share of the smoothness
_LEAST = 1e-4  # primary, in units of the open beam
_RANGE = (0.1, 10.0)  # of the factor


class FollowingBackground:
    """DRRs with a background refitted to each candidate.

    A background estimated with the implant at one place explains part of the images that the implant would explain
    elsewhere, and so holds it there. So it is fitted to each candidate (variable projection, Golub & Pereyra
    1973): the primary T of a DRR is scaled by the factor r that explains the measured intensity I best within a
    Gaussian window, `r = G (T (I - s)) / G (T T)`, with the scatter s.

    Args:
        measured: Line integrals -ln I, shape (V, rows, cols).
        mask: True where a pixel counts.
        scatter_shapes: Distribution of scatter over the detector, shape (2, V, rows, cols); uniform if None.
        sigma_px: Smoothness of the background, pixels.
    """

    def __init__(self, measured: Tensor, mask: Tensor, scatter_shapes: Tensor | None, sigma_px: float) -> None:
        self.intensity, self.mask = torch.exp(-measured), mask
        self.scatter_shapes = scatter_shapes
        self.block = max(1, int(PIXELS_OF_SIGMA * sigma_px))
        self.sigma = sigma_px / self.block

    def __call__(self, lines: Tensor, levels: Tensor) -> Tensor:
        """DRRs (K, V, rows, cols) including the background fitted to them.

        Args:
            lines: DRRs, zero in the open beam.
            levels: Levels of both kinds of scatter, shape (K, 2).
        """
        level = levels[:, 0].to(lines)[:, None, None, None]
        scattered = scattered_signal(levels.to(lines), self.scatter_shapes)
        primary = ((1 + level) * torch.exp(-lines) - scattered).clamp_min(_LEAST)
        seen = primary * self.mask
        correlation = self._smooth(seen * (self.intensity - scattered))
        factor = (correlation / self._smooth(seen * primary).clamp_min(_LEAST**2)).clamp(*_RANGE)
        return torch.log1p(level) - torch.log(self._enlarged(factor) * primary + scattered)

    def _smooth(self, images: Tensor) -> Tensor:
        pooled = avg_pool2d(images.flatten(0, 1), self.block, ceil_mode=True)
        return gaussian_blur(pooled, self.sigma).unflatten(0, images.shape[:2])

    def _enlarged(self, images: Tensor) -> Tensor:
        rows, cols = self.mask.shape[-2:]
        size = (images.shape[-2] * self.block, images.shape[-1] * self.block)
        return interpolate(images, size=size, mode="bilinear", align_corners=False)[..., :rows, :cols]


def resized(images: Tensor, det_shape: tuple[int, int]) -> Tensor:
    """Smooth images (V, rows, cols) on other pixels of the same detector."""
    return interpolate(images[None], size=tuple(det_shape), mode="bilinear", align_corners=False)[0]

"""Physical model of a flat-panel detector: focal spot, scatter, scintillator, glare, quanta, faults, saturation.

It differs from the registration's model on purpose. Blur is a transfer function, not a Gaussian. Scatter is a sum of
kernels whose strength and reach depend on the object's thickness (after Sun and Star-Lack 2010), not a blurred image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate, pad

_SCATTER_MM = 4.0  # pitch on which scatter is computed: it is smooth
_KERNELS = ((15.0, 0.5), (40.0, 1.0))  # (reach in mm, amplitude) for thin and for thick objects
_THICK = 2.0  # line integral at which half of the scatter comes from the kernel of thick objects
_ABSORBED, _REMOVED = 0.25, 0.9  # scatter comes from p^a ln(1/p)^b
_SHADOW = 0.9  # pixels with a smaller primary count as behind the object
_REACHES = 8.0  # padding around the image, in multiples of the blur's reach


@dataclass(frozen=True)
class FlatPanel:
    """Detector model, from the transmitted beam to the counts in a file.

    Attributes:
        focal_spot_mm: Width of a square focal spot.
        half_contrast_lp_mm: Spatial frequency at which the scintillator keeps half of the contrast, `1 / (1 + f^2 /
            f_half^2)`.
        glare: Share of the light that spreads in the panel, `exp(-r / reach)`.
        glare_reach_mm: Reach of the glare, mm.
        photons: Quanta per pixel in the open beam; infinite: no quantum noise. They are drawn before the scintillator
            spreads them, so the noise is correlated.
        electronic_noise: Standard deviation of the electronic noise, counts.
        open_beam: Counts of the open beam.
        offset: Counts without a beam.
        bits: The largest count is `2^bits - 1`.
        gain_error: Standard deviation of the pixels' relative gain errors after correction.
        dead_pixels: Share of pixels that always read zero.
        seed: Seed of the gain errors and dead pixels, which are the same in all images of a panel.
    """

    focal_spot_mm: float = 0.3
    half_contrast_lp_mm: float = 1.6
    glare: float = 0.06
    glare_reach_mm: float = 1.5
    photons: float = 2e4
    electronic_noise: float = 2.0
    open_beam: float = 2800.0
    offset: float = 0.0
    bits: int = 12
    gain_error: float = 0.0
    dead_pixels: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.open_beam > 0 and self.photons > 0):
            raise ValueError(f"open_beam and photons must be positive, got {self.open_beam} and {self.photons}")
        if not 1 <= self.bits <= 16:
            raise ValueError(f"bits must be 1 to 16, got {self.bits}")
        for name in ("focal_spot_mm", "half_contrast_lp_mm", "glare", "glare_reach_mm", "electronic_noise"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @classmethod
    def ideal(cls, **changes: Any) -> FlatPanel:
        """Panel of 16 bits without blur, glare and noise; counts are still rounded.

        Args:
            changes: Attributes that differ, such as `photons` for quantum noise.

        >>> FlatPanel.ideal().saturation
        65535
        """
        sharp = {"focal_spot_mm": 0.0, "half_contrast_lp_mm": math.inf, "glare": 0.0}
        clean = {"photons": math.inf, "electronic_noise": 0.0, "open_beam": 60000.0, "bits": 16}
        return cls(**{**sharp, **clean, **changes})

    def without_noise(self) -> FlatPanel:
        """The panel without quantum and electronic noise; counts are still rounded."""
        return replace(self, photons=math.inf, electronic_noise=0.0)

    @property
    def saturation(self) -> int:
        """The largest count."""
        return 2**self.bits - 1

    def penumbra(self, primary: Tensor, pixel_spacing: Sequence[float], magnification: float) -> Tensor:
        """Primary (rows, cols) blurred by the focal spot at the object's magnification."""
        width = self.focal_spot_mm * (magnification - 1)
        if width <= 0:
            return primary
        return _filtered(primary, pixel_spacing, width, lambda fv, fu: torch.sinc(width * fv) * torch.sinc(width * fu))

    def detected(self, signal: Tensor, pixel_spacing: Sequence[float]) -> Tensor:
        """Signal (rows, cols) blurred by the scintillator and its glare."""

        def transfer(fv: Tensor, fu: Tensor) -> Tensor:
            squared = fv.square() + fu.square()
            sharp = 1 / (1 + squared / self.half_contrast_lp_mm**2)
            tail = (1 + (2 * math.pi * self.glare_reach_mm) ** 2 * squared) ** -1.5
            return torch.lerp(sharp, tail, self.glare)

        return _filtered(signal, pixel_spacing, self.glare_reach_mm, transfer)

    def counts(self, signal: Tensor, pixel_spacing: Sequence[float], generator: torch.Generator) -> Tensor:
        """Counts (rows, cols), uint16, of a signal given in units of the open beam."""
        if math.isfinite(self.photons):
            signal = torch.poisson(signal * self.photons, generator=generator) / self.photons
        gain, dead = _faults(self, tuple(signal.shape))
        counts = self.detected(signal, pixel_spacing) * gain * self.open_beam + self.offset
        noise = torch.randn(counts.shape, dtype=counts.dtype, generator=generator, device="cpu")
        counts = (counts + self.electronic_noise * noise).round().clamp(0, self.saturation)
        return counts.masked_fill(dead, 0).to(torch.int32).to(torch.uint16)


@lru_cache(maxsize=1)
def _faults(panel: FlatPanel, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Pixel gains and mask of dead pixels (rows, cols), the same in every view."""
    generator = torch.Generator(device="cpu").manual_seed(panel.seed)
    normal = torch.randn(shape, dtype=torch.float64, generator=generator, device="cpu")
    uniform = torch.rand(shape, dtype=torch.float64, generator=generator, device="cpu")
    return 1 + panel.gain_error * normal, uniform < panel.dead_pixels


def scatter_shapes(primaries: Tensor, pixel_spacing: Sequence[float]) -> Tensor:
    """Scatter (V, rows, cols) for given primaries, in arbitrary units.

    The object is assumed to continue above and below the panel, with air to its left and right.
    """
    (rows, cols), (dv, du) = primaries.shape[-2:], pixel_spacing
    coarse_shape = (max(1, round(rows * dv / _SCATTER_MM)), max(1, round(cols * du / _SCATTER_MM)))
    pitch = [n * d / m for n, d, m in zip((rows, cols), pixel_spacing, coarse_shape, strict=True)]
    primary = adaptive_avg_pool2d(primaries[:, None], coarse_shape)[:, 0].clamp(1e-9, 1)
    thickness = -primary.log()
    source = primary**_ABSORBED * thickness**_REMOVED
    thick = thickness / (thickness + _THICK)
    total = torch.zeros_like(primary)
    for (reach, amount), share in zip(_KERNELS, (1 - thick, thick), strict=True):
        total = total + amount * _spread(source * share, pitch, reach)
    return interpolate(total[:, None], size=(rows, cols), mode="bilinear", align_corners=False)[:, 0].clamp_min(0)


def scattered(primaries: Tensor, pixel_spacing: Sequence[float], scatter_to_primary: float) -> Tensor:
    """Scatter (V, rows, cols), scaled to a given ratio of mean scatter to mean primary in the object's shadow."""
    if scatter_to_primary == 0 or not bool((primaries < _SHADOW).any()):
        return torch.zeros_like(primaries)
    shape = scatter_shapes(primaries, pixel_spacing)
    return shape * (scatter_to_primary / mean_ratio(shape, primaries))


def mean_ratio(scatter: Tensor, primaries: Tensor) -> float:
    """Mean scatter over mean primary in the object's shadow; zero if there is no shadow."""
    shadow = primaries < _SHADOW
    return float(scatter[shadow].mean() / primaries[shadow].mean()) if bool(shadow.any()) else 0.0


def _spread(source: Tensor, pitch: Sequence[float], reach: float) -> Tensor:
    """Sources (V, rows, cols) convolved with the kernel `(1 + (r / reach)^2)^-1.5`, normalised to a sum of one."""
    margin = [math.ceil(3 * reach / p) for p in pitch]
    padded = pad(source[:, None], (0, 0, margin[0], margin[0]), mode="replicate")
    padded = pad(padded, (margin[1], margin[1]))[:, 0]
    offsets = [
        torch.fft.fftfreq(n, 1 / n, dtype=source.dtype, device="cpu") * p for n, p in zip(padded.shape[1:], pitch)
    ]
    kernel = (1 + (offsets[0][:, None].square() + offsets[1].square()) / reach**2) ** -1.5
    product = torch.fft.rfft2(padded) * torch.fft.rfft2(kernel / kernel.sum())
    spread = torch.fft.irfft2(product, s=padded.shape[1:])
    rows, cols = source.shape[1:]
    return spread[:, margin[0] : margin[0] + rows, margin[1] : margin[1] + cols]


def _filtered(
    image: Tensor, pixel_spacing: Sequence[float], reach: float, transfer: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    """Filter an image (rows, cols) by a transfer function of (fv, fu) in 1/mm, mirrored at the image's edges."""
    rows, cols = image.shape
    margins = [
        min(math.ceil(_REACHES * reach / d) + 4, n - 1) for d, n in zip(pixel_spacing, (rows, cols), strict=True)
    ]
    wide = pad(image[None, None], (margins[1], margins[1], margins[0], margins[0]), mode="reflect")[0, 0]
    fv = torch.fft.fftfreq(wide.shape[0], pixel_spacing[0], dtype=image.dtype, device="cpu")
    fu = torch.fft.rfftfreq(wide.shape[1], pixel_spacing[1], dtype=image.dtype, device="cpu")
    filtered = torch.fft.irfft2(torch.fft.rfft2(wide) * transfer(fv[:, None], fu), s=wide.shape)
    return filtered[margins[0] : margins[0] + rows, margins[1] : margins[1] + cols].clamp_min(0)

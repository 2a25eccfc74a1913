"""Images of meshes and solids from a flat-panel scanner: polyenergetic, with scatter, blur, noise, quantisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.physics import Beam, Spectrum, gaussian_blur, material
from torchkcreg.physics.blur import convolve, gaussian_kernel

from .parts import Part, material_paths

SCATTER_BLOCK = 8  # pixels along each side of the blocks on which scatter, which is smooth, is computed


@dataclass(frozen=True)
class DetectorModel:
    """Detector model, from the transmitted beam to the counts in the file.

    Attributes:
        scatter_fraction: Scatter behind the object, as a share of the broadly blurred primary.
        scatter_sigma_mm: Standard deviation of this blur on the detector, mm.
        scatter_removed: Amplitude of the scatter from radiation removed by the object (Ohnesorge et al. 1999): it
            multiplies the broadly blurred `p ln(1 / p)` of the primary p. A quarter of it has three times the width.
        psf_sigma_mm: Standard deviation of the blur by focal spot and scintillator on the detector, mm.
        glare_share: Share of the signal in the long tail of the scintillator's blur (glare).
        glare_sigma_mm: Standard deviation of the glare, mm.
        open_beam: Counts of the unattenuated beam without scatter.
        photons: Detected photons per pixel in the unattenuated beam; infinite: no quantum noise.
        electronic_noise: Standard deviation of the electronic noise, counts.
        bits: The largest count is `2^bits - 1`.
        supersample: Sub-pixels along each side of a pixel whose transmission is averaged.

    Raises:
        ValueError: If a value is out of range.
    """

    scatter_fraction: float = 0.1
    scatter_sigma_mm: float = 25.0
    scatter_removed: float = 0.0
    psf_sigma_mm: float = 0.25
    glare_share: float = 0.0
    glare_sigma_mm: float = 0.8
    open_beam: float = 2800.0
    photons: float = 2e4
    electronic_noise: float = 2.0
    bits: int = 12
    supersample: int = 2

    def __post_init__(self) -> None:
        for name in (
            "scatter_fraction",
            "scatter_sigma_mm",
            "scatter_removed",
            "psf_sigma_mm",
            "glare_share",
            "glare_sigma_mm",
            "electronic_noise",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not (self.open_beam > 0 and self.photons > 0):
            raise ValueError(f"open_beam and photons must be positive, got {self.open_beam} and {self.photons}")
        if self.supersample < 1 or not 1 <= self.bits <= 16:
            raise ValueError(
                f"supersample and bits must be 1 or more, bits at most 16, got {self.supersample}, {self.bits}"
            )

    @property
    def saturation(self) -> int:
        """The largest count."""
        return 2**self.bits - 1

    def without_noise(self) -> DetectorModel:
        """Copy of the detector without quantum and electronic noise. Counts are still rounded."""
        return replace(self, photons=float("inf"), electronic_noise=0.0)


def simulate_projections(
    geometry: ConeBeamGeometry,
    parts: Sequence[Part],
    spectrum: Spectrum | Mapping[str, Spectrum],
    *,
    detector: DetectorModel | None = None,
    seed: int = 0,
) -> Tensor:
    """Simulated projections: counts `(V, rows, cols)`, uint16.

    The transmission `sum_k w_k exp(-sum_m mu_mk L_m)` of the sub-pixels is averaged over each pixel and blurred by the
    point spread function. Scatter and Poisson noise of the photons are added, and the signal is multiplied by the open
    beam. Then Gaussian electronic noise is added, and the counts are rounded and clipped to the detector's range. Path
    lengths are exact averages over sub-pixels for meshes and means of 2 x 2 rays for solids.

    Args:
        geometry: The views.
        parts: Bodies in the beam, in the world's frame.
        spectrum: The detected spectrum, or one for each source of the geometry, by name.
        detector: Detector model; the default one if None.
        seed: Seed of the noise.

    Raises:
        ValueError: If the parts are invalid (see `material_paths`), or the source of a view has no spectrum.
    """
    detector = detector or DetectorModel()
    if isinstance(spectrum, Spectrum):
        spectra = [spectrum] * geometry.num_views
    elif missing := sorted(set(geometry.sources or ("no source",)) - set(spectrum)):
        raise ValueError(f"spectrum must have one for each source, got none for {', '.join(missing)}")
    else:
        spectra = [spectrum[source] for source in geometry.sources or ()]
    generator = torch.Generator().manual_seed(seed)
    images = []
    for matrix, view_spectrum in zip(geometry.projection_matrices, spectra, strict=True):
        primary = _primary(matrix.cpu(), geometry.det_shape, parts, view_spectrum, detector.supersample)
        signal = _detected(primary, geometry.pixel_spacing, detector)
        images.append(_counts(signal, detector, generator))
    return torch.stack(images)


def _primary(
    matrix: Tensor, det_shape: tuple[int, int], parts: Sequence[Part], spectrum: Spectrum, factor: int
) -> Tensor:
    """Transmitted share of the beam (rows, cols), averaged over the sub-pixels of each pixel."""
    fine = matrix.clone()
    # sub-pixel centres: u' = f u + (f - 1) / 2
    fine[:2] = factor * matrix[:2] + (factor - 1) / 2 * matrix[2]
    fine_shape = (det_shape[0] * factor, det_shape[1] * factor)
    paths = material_paths(parts, fine, fine_shape)
    if not paths:
        return torch.ones(det_shape, dtype=torch.float64)
    beam = Beam.of([material(name) for name in paths], spectrum, num_bins=None)
    lengths = torch.stack(list(paths.values()))[None, :, None]
    return beam.transmission(lengths, pooling=factor)[0, 0]


def _detected(primary: Tensor, pixel_spacing: tuple[float, float], detector: DetectorModel) -> Tensor:
    """Blurred primary plus scatter, in units of the open beam."""
    signal = _spread_out(primary, pixel_spacing, detector.psf_sigma_mm)
    if detector.glare_share > 0:
        glare = _spread_out(primary, pixel_spacing, detector.glare_sigma_mm)
        signal = torch.lerp(signal, glare, detector.glare_share)
    if detector.scatter_fraction > 0:
        signal = signal + detector.scatter_fraction * _smooth(primary, pixel_spacing, detector.scatter_sigma_mm)
    if detector.scatter_removed > 0:
        source = torch.xlogy(primary, primary).neg()
        for share, widths in ((0.75, 1.0), (0.25, 3.0)):
            wide = _smooth(source, pixel_spacing, widths * detector.scatter_sigma_mm)
            signal = signal + share * detector.scatter_removed * wide
    return signal


def _spread_out(image: Tensor, pixel_spacing: tuple[float, float], sigma_mm: float) -> Tensor:
    for dim, spacing in zip((-2, -1), pixel_spacing):
        sigma = torch.tensor(sigma_mm / spacing, dtype=torch.float64)
        image = convolve(image, gaussian_kernel(sigma).tolist(), dim)
    return image


def _smooth(image: Tensor, pixel_spacing: tuple[float, float], sigma_mm: float) -> Tensor:
    """Broad blur of an image (rows, cols), computed on blocks of pixels."""
    rows, cols = image.shape
    coarse_shape = (max(1, rows // SCATTER_BLOCK), max(1, cols // SCATTER_BLOCK))
    coarse = adaptive_avg_pool2d(image[None, None], coarse_shape)
    smooth = gaussian_blur(coarse, sigma_mm / (sum(pixel_spacing) / 2) / SCATTER_BLOCK)
    return interpolate(smooth, size=(rows, cols), mode="bilinear", align_corners=False)[0, 0]


def _counts(signal: Tensor, detector: DetectorModel, generator: torch.Generator) -> Tensor:
    """Noisy, rounded counts (rows, cols), uint16, of a signal in units of the open beam."""
    if detector.photons != float("inf"):
        signal = torch.poisson(signal * detector.photons, generator=generator) / detector.photons
    counts = signal * detector.open_beam
    counts = counts + detector.electronic_noise * torch.randn(counts.shape, dtype=counts.dtype, generator=generator)
    return counts.round().clamp(0, detector.saturation).to(torch.int32).to(torch.uint16)

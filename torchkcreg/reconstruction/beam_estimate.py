"""Estimation of an unknown beam spectrum from the shadow of known metal (after Xu et al. 2017, Poly-KCR)."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq, least_squares
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import Beam, Spectrum, Veil, material, tungsten_spectrum
from torchkcreg.progress import progress_bar

from .corrections import floored_line_integrals, scatter_image
from .fdk import fdk
from .inpainting import filled_transmission, inpainted
from .kcrec import component_path_lengths, known_materials, unknown_share, without_components
from .spectral import BeamModel
from .system import VoxelSystem, projected

FEWEST_PIXELS = 200
MOST_PIXELS = 5000
LEAST_MM = 0.5  # of metal in a pixel, for the pixel to be used
LEAST_PER_MM = 0.1  # 1/mm, below the attenuation of the lightest implant alloys
STEEPEST = 0.15  # relative change of the metal path to the next pixel: at edges a pixel averages exponentials
LEAST_TRANSMISSION = 0.003  # below it the signal holds no information on the beam
BACKGROUND = 0.03  # error of the interpolated background's line integral
NOISE = 2e-3  # of the transmission
NEAR_MODE = 0.06  # relative to water: attenuation range counted as the same tissue
TISSUE_RANGE = (0.85, 1.15)  # relative to water: the most frequent attenuation outside this range is not soft tissue
TUBE_KVP = (70.0, 80.0, 90.0, 100.0, 110.0, 120.0)  # of the packaged spectra, of which the best is chosen
NUM_BINS = 12
INDEPENDENT = 400  # effective number of independent pixels: background and scatter errors extend over many pixels
# standard deviations of the priors
HARDNESS_MM = 2.0  # of aluminium: the scanner's filter minus the packaged spectra's
SCALE = 0.03  # of an alloy's relative attenuation
UNLIKELY = 3.0  # standard deviations from the prior beyond which a warning is given
SCATTER = 0.05  # relative error of the scatter fitted to the air
TISSUE = 0.02  # of the attenuation of the predominant soft tissue relative to water
KNOWN_TISSUE = 0.003  # the same, if the attenuation is given


@dataclass(frozen=True)
class MetalShadow:
    """Pixels behind metal: path lengths (M, N), all others (N,); and attenuation around the metal."""

    lengths: Tensor
    primary: Tensor
    scatter: Tensor
    background: Tensor  # line integrals of the background
    deviation: Tensor  # of the primary
    typical: float  # median measured line integral around the metal
    tissue: float  # most frequent attenuation relative to water, for beam `start`; nan if not soft tissue
    start: BeamModel


def metal_shadow(
    primary: Tensor,
    scatter: Tensor,
    metal: Tensor,
    unknown: Tensor,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    beam: BeamModel,
    mask: Tensor | None,
    backend: str,
) -> MetalShadow:
    """Pixels behind smooth metal; the background is reconstructed from data inpainted across the metal's shadow."""
    lines = floored_line_integrals(primary)
    everything = [(slice(None), beam.weights[:, None, None, None])]
    around = inpainted(without_components(lines, everything, beam)[0], metal, mask=mask)
    volume = fdk(around, geometry, grid, backend=backend).clamp_min(0)
    system = VoxelSystem(geometry, grid, backend=backend)
    reprojected, displaced = projected(system, volume), projected(system, volume * (1 - unknown))
    # add the reprojection error interpolated from around the shadow; subtract the background displaced by metal
    background = reprojected + inpainted(around - reprojected, metal, mask=mask) - displaced
    total = metal.sum(0)
    steps = max_pool2d(total[:, None], 3, 1, 1)[:, 0] + max_pool2d(-total[:, None], 3, 1, 1)[:, 0]
    behind = torch.exp(-background) * torch.exp(-LEAST_PER_MM * total)
    used = (total > LEAST_MM) & (steps < STEEPEST * total) & (behind > LEAST_TRANSMISSION)
    if mask is not None:
        used &= mask != 0
    places = used.flatten().nonzero()[:, 0]
    if len(places) < FEWEST_PIXELS:
        raise ValueError(
            f"only {len(places)} pixels lie behind smooth metal, too few to estimate the beam: give a spectrum"
        )
    places = places[:: max(1, len(places) // MOST_PIXELS)]
    at = lambda image: image.flatten()[places].double()  # noqa: E731
    expected = at(primary).clamp_min(LEAST_TRANSMISSION)
    return MetalShadow(
        metal.flatten(1)[:, places].double(),
        at(primary),
        at(scatter),
        at(background),
        (NOISE**2 + (BACKGROUND * expected) ** 2).sqrt(),
        float(lines[(total == 0) & (lines > lines.max() / 10)].median()),
        _tissue(volume, beam.water),
        beam,
    )


def _tissue(volume: Tensor, water: float) -> float:
    """Most frequent attenuation in the object, relative to water; nan if it is not soft tissue."""
    low, high = 0.5, 2.0
    counts = torch.histc(volume / water, bins=150, min=low, max=high)
    counts = torch.nn.functional.avg_pool1d(counts[None], 5, 1, 2)[0]
    mode = low + (float(counts.argmax()) + 0.5) * (high - low) / len(counts)
    if not TISSUE_RANGE[0] < mode < TISSUE_RANGE[1]:
        return float("nan")
    share = volume / water
    return float(share[(share - mode).abs() < NEAR_MODE].median())


@dataclass(frozen=True)
class BeamEstimate:
    """Beam and metal attenuation estimated from the metal's shadow.

    Attributes:
        beam: Beam model for the reconstruction, with the scaled attenuation of `alloys`.
        kvp: Tube voltage of the packaged spectrum; None if a spectrum was given.
        hardness_mm: Additional aluminium filter, mm; negative if the beam is softer than the spectrum.
        alloys: Alloy fitted for each of the components' materials.
        scales: Attenuation of each relative to the packaged alloy.
        scatter_scale: Scatter behind the metal relative to the given scatter.
        lengths_mm: Path lengths (M, N) in the pixels used.
        measured: Transmission of the metal alone in these pixels (N,): measured over modelled primary, times the
            modelled transmission of the metal.
        residual: Root mean square residual of the primary, in standard deviations.
        cost: Minimum of the cost function (half a sum of squares), by which voltages and alloys are compared.
    """

    beam: BeamModel
    kvp: float | None
    hardness_mm: float
    alloys: tuple[str, ...]
    scales: tuple[float, ...]
    scatter_scale: float
    lengths_mm: Tensor
    measured: Tensor
    residual: float
    cost: float

    def in_words(self) -> dict[str, Any]:
        """Summary for a record: plain numbers and names."""
        names = ("kvp", "hardness_mm", "alloys", "scales", "scatter_scale", "residual", "cost")
        return {name: getattr(self, name) for name in names}


def estimate_beam(
    transmission: Tensor,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    components: Sequence[KnownComponent],
    *,
    spectrum: Spectrum | None = None,
    scatter: Veil | Tensor | None = None,
    mask: Tensor | None = None,
    alloys: Sequence[str] = (),
    soft_tissue: float | None = None,
    backend: str = "auto",
    progress: bool | None = False,
) -> BeamEstimate:
    """Estimate the beam and the metals' attenuation from the transmission of known metal.

    The line integral as a function of the metal's path length is a curve that rises and flattens. The path lengths come
    from the registered components, the background from a reconstruction that leaves out their shadow (`inpainted`).
    The fit determines the tube voltage, the filter in mm of aluminium and a factor of each metal's attenuation (another
    alloy, another density). The fitted curve therefore always belongs to a physical spectrum and metal.

    Args:
        transmission: Measured intensity over the open beam's, (V, rows, cols).
        geometry: The views.
        grid: Voxels that contain everything in the beam.
        components: Registered metal components.
        spectrum: Detected spectrum, if it is known and only the metal is not.
        scatter: See `prepare`.
        mask: 0 where a pixel holds no measurement.
        alloys: Names of further materials to try for each component; without them, only its given material is used.
        soft_tissue: Attenuation of the object's predominant tissue relative to water, if known: 1 in a water bath. It
            fixes the scale of all attenuation, which the metal's shadow alone determines only to 1-2 %.
        backend: Projector backend.
        progress: Show a progress bar over the spectra and alloys; None: on a terminal only.

    Raises:
        ValueError: If there are no components, or too few pixels behind metal.
    """
    if not components:
        raise ValueError("the beam is estimated from known metal, but there are no components")
    if mask is not None:
        transmission = filled_transmission(transmission, mask)
    veil = scatter_image(transmission, scatter, geometry.pixel_spacing)
    metal = component_path_lengths(components, geometry, backend=backend).to(transmission)
    start = BeamModel.polyenergetic([], spectrum or tungsten_spectrum())
    unknown = unknown_share(components, grid).to(transmission)
    shadow = metal_shadow(transmission - veil, veil, metal, unknown, geometry, grid, start, mask, backend)
    spectra = {None: spectrum} if spectrum is not None else {kvp: tungsten_spectrum(kvp) for kvp in TUBE_KVP}
    metals = list(itertools.product(*(dict.fromkeys([name, *alloys]) for name in known_materials(components))))
    tried = progress_bar(list(itertools.product(spectra.items(), metals)), desc="beam", shown=progress)
    fits = [_fitted(shadow, candidate, kvp, names, soft_tissue) for (kvp, candidate), names in tried]
    best = min(fits, key=lambda fit: fit.cost)
    for doubt in _doubts(best, shadow):
        warnings.warn(f"the estimated beam is doubtful: {doubt}", stacklevel=2)
    return best


def _doubts(estimate: BeamEstimate, shadow: MetalShadow) -> list[str]:
    """Reasons why an estimate may be wrong."""
    doubts = []
    if math.isnan(shadow.tissue):
        doubts.append("there is no soft tissue around the metal to fix the scale: all attenuation may be off")
    for alloy, scale in zip(estimate.alloys, estimate.scales):
        if abs(scale - 1) > UNLIKELY * SCALE:
            doubts.append(f"{alloy} is fitted with {scale:.2f} times its attenuation: wrong metal or wrong position?")
    if abs(estimate.hardness_mm) > UNLIKELY * HARDNESS_MM:
        doubts.append(
            f"the filter differs by {estimate.hardness_mm:.0f} mm of aluminium from the usual: give a spectrum"
        )
    return doubts


def _fitted(
    shadow: MetalShadow, spectrum: Spectrum, kvp: float | None, metals: Sequence[str], soft_tissue: float | None
) -> BeamEstimate:
    """Estimate with the filter and scales that best fit the shadow."""
    water, reference_kev = material("water"), float(shadow.start.reference_kev or 0)
    whole = Beam.of([*(material(name) for name in metals), water], spectrum, num_bins=NUM_BINS)
    energies, logs = whole.energies_kev.numpy(), whole.weights.log().numpy()
    aluminium, attenuation = whole.aluminium.numpy(), whole.attenuation[:-1].numpy()
    ratio = (water.attenuation(energies.tolist()) / water.attenuation((reference_kev,))).numpy()
    lengths, primary, scatter, background, deviation = (
        x.cpu().numpy() for x in (shadow.lengths, shadow.primary, shadow.scatter, shadow.background, shadow.deviation)
    )

    def shares(hardness: float) -> np.ndarray:
        weights = np.exp(logs - hardness * aluminium)
        return weights / weights.sum()

    def passed(x: np.ndarray, behind: np.ndarray) -> np.ndarray:
        metal = np.einsum("m,me,mn->en", x[2:], attenuation, lengths)
        return shares(x[0]) @ np.exp(-metal - ratio[:, None] * behind)

    def residual(x: np.ndarray) -> np.ndarray:
        return (passed(x, background) + x[1] * scatter - primary) / deviation

    knows_tissue, start = not math.isnan(shadow.tissue), shadow.start
    start_line = _corrected(start.weights.numpy(), start.background.numpy(), shadow.typical) if knows_tissue else 1.0

    likely, spread = (1.0, TISSUE) if soft_tissue is None else (soft_tissue, KNOWN_TISSUE)

    def tissue(x: np.ndarray) -> float:
        """Tissue attenuation relative to water; scales with the beam like a typical corrected line integral."""
        return shadow.tissue * _corrected(shares(x[0]), ratio, shadow.typical) / start_line if knows_tissue else likely

    def misfit(x: np.ndarray) -> np.ndarray:
        data = residual(x) * math.sqrt(min(1.0, INDEPENDENT / len(primary)))
        prior = [x[0] / HARDNESS_MM, x[1] / SCATTER, math.log(tissue(x) / likely) / spread]
        return np.concatenate([data, prior, (x[2:] - 1) / SCALE])

    fit = least_squares(misfit, np.concatenate([[0.0, 0.0], np.ones(len(metals))]))
    best = fit.x
    beam = whole.behind(float(best[0]), range(len(metals)))
    scaled = Beam(beam.energies_kev, beam.weights, beam.attenuation * torch.tensor(best[2:])[:, None])
    return BeamEstimate(
        BeamModel.behind(scaled, reference_kev=reference_kev),
        kvp,
        float(best[0]),
        tuple(metals),
        tuple(float(s) for s in best[2:]),
        1 + float(best[1]),
        shadow.lengths,
        torch.from_numpy((primary - best[1] * scatter) / passed(best, background) * passed(best, 0 * background)),
        float(np.sqrt(np.mean(residual(best) ** 2))),
        float(fit.cost),
    )


def _corrected(shares: np.ndarray, ratio: np.ndarray, line: float) -> float:
    """Line integral of the background at the reference energy that is measured as `line` with the beam."""
    return float(brentq(lambda b: -math.log(shares @ np.exp(-ratio * b)) - line, 0, 10 * line + 1))

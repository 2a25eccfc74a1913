"""A beam that nobody knows, out of the shadow of known metal (after Xu et al. 2017, Poly-KCR)."""

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
LEAST_MM = 0.5  # of metal in a pixel that is used
LEAST_PER_MM = 0.1  # attenuation of the lightest implant alloys, 1/mm, less than that
STEEPEST = 0.15  # change of the metal's length to the next pixel, as a share: rims are averages of exponentials
LEAST_TRANSMISSION = 0.003  # below it nothing is left of the beam that tells anything
BACKGROUND = 0.03  # of a line integral: the interpolated background's error
NOISE = 2e-3  # of a transmission
NEAR_MODE = 0.06  # of water: what is taken for the same tissue
TISSUE_RANGE = (0.85, 1.15)  # of water: what most of an object is beyond that is no soft tissue
TUBE_KVP = (70.0, 80.0, 90.0, 100.0, 110.0, 120.0)  # packaged spectra, from among which the nearest is taken
NUM_BINS = 12
INDEPENDENT = 400  # pixels: what is wrong with the background or the scatter is so over many of them
# standard deviations of what is likely before the data speak
HARDNESS_MM = 2.0  # of aluminium, of a scanner's filter beside the packaged spectra's
SCALE = 0.03  # of an alloy's attenuation
UNLIKELY = 3.0  # so many of these are told
SCATTER = 0.05  # of the scatter that was fitted to the air
TISSUE = 0.02  # of the attenuation of the soft tissue that most of an object is, beside water
KNOWN_TISSUE = 0.003  # of the same, where it is known


@dataclass(frozen=True)
class MetalShadow:
    """Pixels behind metal: path lengths (M, N); all others (N,). And what stands around the metal."""

    lengths: Tensor
    primary: Tensor
    scatter: Tensor
    background: Tensor  # its line integrals
    deviation: Tensor  # of the primary
    typical: float  # line integral around the metal, as measured
    tissue: float  # what most of the object is, over water, if the beam is `start`; nan where it is no soft tissue
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
    """Pixels behind smooth metal, and the background in them out of a reconstruction around the metal's shadow."""
    lines = floored_line_integrals(primary)
    everything = [(slice(None), beam.weights[:, None, None, None])]
    around = inpainted(without_components(lines, everything, beam)[0], metal, mask=mask)
    volume = fdk(around, geometry, grid, backend=backend).clamp_min(0)
    system = VoxelSystem(geometry, grid, backend=backend)
    seen, displaced = projected(system, volume), projected(system, volume * (1 - unknown))
    # what the volume lacks is as around the shadow, and where there is metal there is nothing else
    background = seen + inpainted(around - seen, metal, mask=mask) - displaced
    total = metal.sum(0)
    steps = max_pool2d(total[:, None], 3, 1, 1)[:, 0] + max_pool2d(-total[:, None], 3, 1, 1)[:, 0]
    behind = torch.exp(-background) * torch.exp(-LEAST_PER_MM * total)
    used = (total > LEAST_MM) & (steps < STEEPEST * total) & (behind > LEAST_TRANSMISSION)
    if mask is not None:
        used &= mask != 0
    places = used.flatten().nonzero()[:, 0]
    if len(places) < FEWEST_PIXELS:
        raise ValueError(
            f"only {len(places)} pixels lie behind smooth metal, too few to tell the beam: give a spectrum"
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
    """What most of an object is, over water; nan where that is no soft tissue."""
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
    """What the metal's shadow told of the beam and of the metal.

    Attributes:
        beam: For the reconstruction; its metals are those of `alloys`, scaled.
        kvp: Tube voltage of the packaged spectrum that it starts from; None where a spectrum was given.
        hardness_mm: Aluminium that it is behind, in mm; negative where it is softer.
        alloys: The metal of each of the components' materials.
        scales: Attenuation of each over that of the packaged alloy.
        scatter_scale: How much more scatter there is behind the metal than was told.
        lengths_mm: Path lengths (M, N) of the pixels that were used.
        measured: What the metal alone let through in them (N,): the measured over the modelled primary, times the
            metal's own.
        residual: Root mean square of what is left of the primary, in standard deviations.
        cost: What was minimised, half a sum of squares: by so much other voltages and alloys were less likely.
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
        """What a record says of it: plain numbers and names."""
        told = ("kvp", "hardness_mm", "alloys", "scales", "scatter_scale", "residual", "cost")
        return {name: getattr(self, name) for name in told}


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
    """The beam, and the metals' attenuation in it, that explain what known metal lets through.

    How much of the beam passes so many millimetres of metal is a curve that rises and flattens. The registered
    components say how many millimetres there are, a reconstruction around their shadow (`inpainted`) what else stands
    in the way. Fitted are the tube's voltage, the filter in mm of aluminium, and a factor of each metal's attenuation
    (another alloy, another density): with these the curve is that of some spectrum and some metal, whatever the data.

    Args:
        transmission: Measured intensity over the open beam's, (V, rows, cols).
        geometry: The views.
        grid: Voxels that hold all that stands in the beam.
        components: Metal in its registered place.
        spectrum: As detected, where it is known, and only the metal is not.
        scatter: See `prepare`.
        mask: 0 where a pixel holds no measurement.
        alloys: Names of materials that any of the components may be of; without, each is of its own.
        soft_tissue: Attenuation over water of what most of the object is, where that is known: 1 in a water bath. It
            fixes the scale of all attenuation, which the metal's shadow leaves free within a per cent or two.
        backend: Of the projectors.
        progress: Show a bar over the spectra and alloys that are tried; None: on a terminal only.

    Raises:
        ValueError: If there are no components, or too few pixels behind metal to tell.
    """
    if not components:
        raise ValueError("a beam is estimated behind known metal, and there are no components")
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
    fits = [_fitted(shadow, one, kvp, names, soft_tissue) for (kvp, one), names in tried]
    best = min(fits, key=lambda fit: fit.cost)
    for doubt in _doubts(best, shadow):
        warnings.warn(f"the estimated beam is doubtful: {doubt}", stacklevel=2)
    return best


def _doubts(found: BeamEstimate, shadow: MetalShadow) -> list[str]:
    """Why an estimate may be far off."""
    doubts = []
    if math.isnan(shadow.tissue):
        doubts.append("there is no soft tissue around the metal to fix its scale: attenuation may be off as a whole")
    for alloy, scale in zip(found.alloys, found.scales):
        if abs(scale - 1) > UNLIKELY * SCALE:
            doubts.append(f"{alloy} comes out with {scale:.2f} of its attenuation: is it another metal, or misplaced?")
    if abs(found.hardness_mm) > UNLIKELY * HARDNESS_MM:
        doubts.append(f"a filter of {found.hardness_mm:.0f} mm of aluminium beside the usual one: give a spectrum")
    return doubts


def _fitted(
    shadow: MetalShadow, spectrum: Spectrum, kvp: float | None, metals: Sequence[str], soft_tissue: float | None
) -> BeamEstimate:
    """The hardness and scales that explain the shadow best."""
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

    def left(x: np.ndarray) -> np.ndarray:
        return (passed(x, background) + x[1] * scatter - primary) / deviation

    knows_tissue, start = not math.isnan(shadow.tissue), shadow.start
    own = _corrected(start.weights.numpy(), start.background.numpy(), shadow.typical) if knows_tissue else 1.0

    likely, spread = (1.0, TISSUE) if soft_tissue is None else (soft_tissue, KNOWN_TISSUE)

    def tissue(x: np.ndarray) -> float:
        """Its attenuation over water, whose logarithm changes with the beam as a typical line integral's does."""
        return shadow.tissue * _corrected(shares(x[0]), ratio, shadow.typical) / own if knows_tissue else likely

    def misfit(x: np.ndarray) -> np.ndarray:
        data = left(x) * math.sqrt(min(1.0, INDEPENDENT / len(primary)))
        prior = [x[0] / HARDNESS_MM, x[1] / SCATTER, math.log(tissue(x) / likely) / spread]
        return np.concatenate([data, prior, (x[2:] - 1) / SCALE])

    fit = least_squares(misfit, np.concatenate([[0.0, 0.0], np.ones(len(metals))]))
    found = fit.x
    beam = whole.behind(float(found[0]), range(len(metals)))
    scaled = Beam(beam.energies_kev, beam.weights, beam.attenuation * torch.tensor(found[2:])[:, None])
    return BeamEstimate(
        BeamModel.behind(scaled, reference_kev=reference_kev),
        kvp,
        float(found[0]),
        tuple(metals),
        tuple(float(s) for s in found[2:]),
        1 + float(found[1]),
        shadow.lengths,
        torch.from_numpy((primary - found[1] * scatter) / passed(found, background) * passed(found, 0 * background)),
        float(np.sqrt(np.mean(left(found) ** 2))),
        float(fit.cost),
    )


def _corrected(shares: np.ndarray, ratio: np.ndarray, line: float) -> float:
    """The background's line integral at the reference energy that comes out of a beam as `line`."""
    return float(brentq(lambda b: -math.log(shares @ np.exp(-ratio * b)) - line, 0, 10 * line + 1))

"""Pixels behind known metal, and what else stands in their way: what tells of the beam."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid

from .corrections import floored_line_integrals
from .fdk import fdk
from .inpainting import inpainted
from .known_component import without_components
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

"""Images of a specimen under each of its loads, as a scanner takes them, with the truth about them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner
from torchkcreg.physics import Beam, Spectrum, material
from torchkcreg.progress import progress_bar
from torchkcreg.simulation.parts import Part, material_paths

from .loaded import ElasticConstruct, Loaded, loaded
from .panel import FlatPanel, mean_ratio, scattered
from .recipe import Recipe, ScannerRecipe
from .specimen import Specimen
from .standing import parts_in_beam


@dataclass(frozen=True, eq=False)
class Acquisition:
    """One configuration of an experiment.

    Attributes:
        name: Of the configuration.
        loaded: Where everything is.
        parts: What stands in the beam.
        counts: Images (V, rows, cols), uint16.
        scatter_to_primary: What it is behind the object, mean over mean.
    """

    name: str
    loaded: Loaded
    parts: list[Part]
    counts: Tensor
    scatter_to_primary: float


def acquisitions(
    specimen: Specimen,
    geometry: ConeBeamGeometry,
    spectrum: Spectrum,
    *,
    progress: bool = True,
    construct: ElasticConstruct | None = None,
    kept: Collection[str] = (),
) -> Iterator[Acquisition]:
    """Each configuration of a specimen's recipe in turn, imaged.

    Args:
        specimen: Without load.
        geometry: The views.
        spectrum: As detected.
        progress: Show it.
        construct: Of the specimen, where it has been made already: making it takes seconds.
        kept: Names of configurations that are left out; the others are what they are with them.

    Raises:
        ValueError: If the parts do not fit into each other, or a load is impossible.
    """
    recipe = specimen.recipe
    asked = [(i, name, load) for i, (name, load) in enumerate(recipe.configurations.items()) if name not in kept]
    if construct is None and any(any(load.force) for _, _, load in asked):
        construct = ElasticConstruct(specimen)
    panel, spacing = panel_of(recipe), geometry.pixel_spacing
    for number, name, load in asked:
        state = loaded(specimen, load, construct)
        parts = parts_in_beam(specimen, state)
        primaries = _primaries(geometry, parts, spectrum, recipe.panel.supersample, name if progress else None)
        scatter = scattered(primaries, spacing, recipe.scatter_to_primary)
        generator = torch.Generator(device="cpu").manual_seed(recipe.seed * 1009 + number)
        magnifications = _magnifications(geometry, state.mesh(specimen.implant))
        images = [
            panel.counts(panel.penumbra(primary, spacing, magnified) + veil, spacing, generator)
            for primary, veil, magnified in zip(primaries, scatter, magnifications, strict=True)
        ]
        yield Acquisition(name, state, parts, torch.stack(images), mean_ratio(scatter, primaries))


def _magnifications(geometry: ConeBeamGeometry, implant: trimesh.Trimesh) -> list[float]:
    """How much each view magnifies the implant's middle."""
    middle = torch.tensor(implant.centroid, dtype=torch.float64, device="cpu")
    _, depths = geometry.project(middle[None])
    magnified: list[float] = (geometry.detector_distances / depths[:, 0]).tolist()
    return magnified


def panel_of(recipe: Recipe) -> FlatPanel:
    """The detector of a recipe, and its tube's focal spot."""
    asked = recipe.panel
    return FlatPanel(
        focal_spot_mm=recipe.tube.focal_spot,
        half_contrast_lp_mm=asked.half_contrast_lp_mm,
        glare=asked.glare,
        glare_reach_mm=asked.glare_reach,
        photons=asked.photons if asked.noise else float("inf"),
        electronic_noise=asked.electronic_noise if asked.noise else 0.0,
        open_beam=asked.open_beam,
        offset=asked.offset,
        bits=asked.bits,
        gain_error=asked.gain_error,
        dead_pixels=asked.dead_pixels,
        seed=recipe.seed,
    )


def views_of(recipe: ScannerRecipe) -> ConeBeamGeometry:
    """The views of a recipe that names no geometry file.

    Raises:
        ValueError: If a view is not in the scan.
    """
    shape = (recipe.rows, recipe.cols)
    scanner = MultisourceScanner(
        sad=recipe.sad,
        sdd=recipe.sdd,
        det_shape=shape,
        det_size_mm=(recipe.rows * recipe.pixel, recipe.cols * recipe.pixel),
        source_z_mm=recipe.sources,
        firing_order=recipe.firing_order,
        num_views=recipe.num_views,
        step_deg=recipe.step,
        start_deg=recipe.start,
        phase_deg=recipe.phase,
    )
    whole = scanner.geometry()
    chosen = whole if recipe.views is None else whole.select(list(recipe.views))
    return chosen if recipe.binning == 1 else chosen.bin(recipe.binning)


def _primaries(
    geometry: ConeBeamGeometry, parts: list[Part], spectrum: Spectrum, factor: int, label: str | None
) -> Tensor:
    """What passes of the beam in each view (V, rows, cols), averaged over pixels, after the exponential."""
    fine = geometry.refined(factor)
    beam: Beam | None = None
    images = []
    for matrix in progress_bar(fine.projection_matrices, desc=label, shown=label is not None):
        paths = material_paths(parts, matrix.cpu(), fine.det_shape)
        beam = beam or Beam.of([material(name) for name in paths], spectrum, num_bins=None)
        images.append(beam.transmission(torch.stack(list(paths.values()))[None, :, None], pooling=factor)[0, 0])
    return torch.stack(images)

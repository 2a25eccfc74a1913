"""Simulated images of a specimen under each of its loads, with the ground truth."""

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
    """Images of one configuration of an experiment.

    Attributes:
        name: Name of the configuration.
        loaded: Positions of implant, fragments and screws under the load.
        parts: Bodies in the beam.
        counts: Images (V, rows, cols), uint16.
        scatter_to_primary: Mean scatter over mean primary behind the object.
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
    """Image the configurations of a specimen's recipe one after the other.

    Args:
        specimen: Specimen without load.
        geometry: The views.
        spectrum: Detected spectrum.
        progress: Show a progress bar.
        construct: Elastic model of the specimen if it exists already: building it takes seconds.
        kept: Names of configurations to skip. The images of the others do not depend on it.

    Yields:
        Acquisition: One for each configuration that is not skipped.

    Raises:
        ValueError: If a part lies half inside the tissue, an insert reaches into a bone, or a load is impossible.
    """
    recipe = specimen.recipe
    jobs = [(i, name, load) for i, (name, load) in enumerate(recipe.configurations.items()) if name not in kept]
    if construct is None and any(any(load.force) for _, _, load in jobs):
        construct = ElasticConstruct(specimen)
    panel, spacing = panel_of(recipe), geometry.pixel_spacing
    for number, name, load in jobs:
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
    """Magnification of the implant's centroid in each view."""
    middle = torch.tensor(implant.centroid, dtype=torch.float64, device="cpu")
    _, depths = geometry.project(middle[None])
    magnified: list[float] = (geometry.detector_distances / depths[:, 0]).tolist()
    return magnified


def panel_of(recipe: Recipe) -> FlatPanel:
    """Detector of a recipe, with the focal spot of its tube."""
    settings = recipe.panel
    return FlatPanel(
        focal_spot_mm=recipe.tube.focal_spot,
        half_contrast_lp_mm=settings.half_contrast_lp_mm,
        glare=settings.glare,
        glare_reach_mm=settings.glare_reach,
        photons=settings.photons if settings.noise else float("inf"),
        electronic_noise=settings.electronic_noise if settings.noise else 0.0,
        open_beam=settings.open_beam,
        offset=settings.offset,
        bits=settings.bits,
        gain_error=settings.gain_error,
        dead_pixels=settings.dead_pixels,
        seed=recipe.seed,
    )


def views_of(recipe: ScannerRecipe) -> ConeBeamGeometry:
    """Views of a recipe that has no geometry file.

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
    """Transmitted share of the beam (V, rows, cols), averaged over each pixel after the exponential."""
    fine = geometry.refined(factor)
    beam: Beam | None = None
    images = []
    for matrix in progress_bar(fine.projection_matrices, desc=label, shown=label is not None):
        paths = material_paths(parts, matrix.cpu(), fine.det_shape)
        beam = beam or Beam.of([material(name) for name in paths], spectrum, num_bins=None)
        images.append(beam.transmission(torch.stack(list(paths.values()))[None, :, None], pooling=factor)[0, 0])
    return torch.stack(images)

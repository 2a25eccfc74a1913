"""Simulated images of a specimen under each of its loads, with the ground truth."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
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
    for number, name, load in jobs:
        state = loaded(specimen, load, construct)
        parts = parts_in_beam(specimen, state)
        counts, ratio = _images(
            geometry,
            parts,
            spectrum,
            panel=panel_of(recipe),
            scatter_to_primary=recipe.scatter_to_primary,
            middle=torch.tensor(state.mesh(specimen.implant).centroid, dtype=torch.float64, device="cpu"),
            supersample=recipe.panel.supersample,
            seed=recipe.seed * 1009 + number,
            label=name if progress else None,
        )
        yield Acquisition(name, state, parts, counts, ratio)


def simulate_projections(
    geometry: ConeBeamGeometry,
    parts: Sequence[Part],
    spectrum: Spectrum | Mapping[str, Spectrum],
    *,
    panel: FlatPanel | None = None,
    scatter_to_primary: float = 0.0,
    supersample: int = 2,
    seed: int = 0,
) -> Tensor:
    """Simulated projections of any parts: counts (V, rows, cols), uint16.

    Path lengths are exact averages over sub-pixels for meshes, and means of 2 x 2 rays for solids. The transmission is
    averaged over each pixel after the exponential. Focal spot, scatter, quanta, scintillator and glare follow, see
    `FlatPanel`; the focal spot's blur is that of an object at the origin.

    Args:
        geometry: The views.
        parts: Bodies in the beam, in the world's frame.
        spectrum: The detected spectrum, or one for each source of the geometry, by name.
        panel: The detector; the default one if None.
        scatter_to_primary: Mean scatter over mean primary in the object's shadow, over all views.
        supersample: Sub-pixels along each side of a pixel.
        seed: Seed of the noise.

    Raises:
        ValueError: If the parts are invalid (see `material_paths`), or the source of a view has no spectrum.
    """
    origin = torch.zeros(3, dtype=torch.float64, device="cpu")
    counts, _ = _images(
        geometry,
        parts,
        spectrum,
        panel=panel or FlatPanel(),
        scatter_to_primary=scatter_to_primary,
        middle=origin,
        supersample=supersample,
        seed=seed,
        label=None,
    )
    return counts


def _images(
    geometry: ConeBeamGeometry,
    parts: Sequence[Part],
    spectrum: Spectrum | Mapping[str, Spectrum],
    *,
    panel: FlatPanel,
    scatter_to_primary: float,
    middle: Tensor,
    supersample: int,
    seed: int,
    label: str | None,
) -> tuple[Tensor, float]:
    """Counts (V, rows, cols), uint16, and the ratio of mean scatter to mean primary behind the object.

    The focal spot's blur is that of an object at `middle` (3,). A `label` shows a progress bar of this name. All else
    is as in `simulate_projections`.
    """
    spacing = geometry.pixel_spacing
    primaries = _primaries(geometry, parts, spectrum, supersample, label)
    scatter = scattered(primaries, spacing, scatter_to_primary)
    generator = torch.Generator(device="cpu").manual_seed(seed)
    images = [
        panel.counts(panel.penumbra(primary, spacing, magnified) + veil, spacing, generator)
        for primary, veil, magnified in zip(primaries, scatter, _magnifications(geometry, middle), strict=True)
    ]
    return torch.stack(images), mean_ratio(scatter, primaries)


def _magnifications(geometry: ConeBeamGeometry, point: Tensor) -> list[float]:
    """Magnification of a point (3,) in each view."""
    _, depths = geometry.project(point[None])
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
    geometry: ConeBeamGeometry,
    parts: Sequence[Part],
    spectrum: Spectrum | Mapping[str, Spectrum],
    factor: int,
    label: str | None,
) -> Tensor:
    """Transmitted share of the beam (V, rows, cols), averaged over each pixel after the exponential."""
    fine = geometry.refined(factor)
    spectra = _spectra(spectrum, geometry)
    beams: dict[int, Beam] = {}
    images = []
    for matrix, of_view in zip(progress_bar(fine.projection_matrices, desc=label, shown=label is not None), spectra):
        paths = material_paths(parts, matrix.cpu(), fine.det_shape)
        if not paths:
            images.append(torch.ones(geometry.det_shape, dtype=torch.float64, device="cpu"))
            continue
        if id(of_view) not in beams:
            beams[id(of_view)] = Beam.of([material(name) for name in paths], of_view, num_bins=None)
        lengths = torch.stack(list(paths.values()))[None, :, None]
        images.append(beams[id(of_view)].transmission(lengths, pooling=factor)[0, 0])
    return torch.stack(images)


def _spectra(spectrum: Spectrum | Mapping[str, Spectrum], geometry: ConeBeamGeometry) -> list[Spectrum]:
    """Spectrum of each view."""
    if isinstance(spectrum, Spectrum):
        return [spectrum] * geometry.num_views
    if missing := sorted(set(geometry.sources or ("no source",)) - set(spectrum)):
        raise ValueError(f"spectrum must have one for each source, got none for {', '.join(missing)}")
    return [spectrum[source] for source in geometry.sources or ()]

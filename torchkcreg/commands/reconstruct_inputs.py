"""Inputs of a reconstruction, read from files and checked: projections, grid, beam, scatter, registered implant."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.io import (
    ProjectionFile,
    read_components,
    read_config,
    read_geometry,
    read_mesh,
    read_projections,
    read_run,
    read_spectrum,
)
from torchkcreg.physics import Beam, Spectrum, material, tungsten_spectrum
from torchkcreg.reconstruction import (
    BeamEstimate,
    BeamModel,
    Veil,
    estimate_beam,
    field_of_view_grid,
    filled,
    fit_veil,
    known_materials,
)
from torchkcreg.registration import RegistrationResult

from .reconstruct_options import ReconstructionFiles, ReconstructionOptions

SAMPLE_VIEWS = 20  # of a streamed scan, for estimates that otherwise use all views
ALLOYS = ("titanium", "steel", "cocr")  # candidates if the implant's material is unknown


def registered_components(
    run: Path,
    *,
    components: Path | None = None,
    material: str | None = None,
    pitch_mm: float | None = None,
    result: RegistrationResult | None = None,
) -> list[KnownComponent]:
    """The registered implant of a run, then its screws, in world mm.

    Args:
        run: Folder of a finished registration.
        components: Screws that replace those of the registration (given or detected); each follows the implant near
            its head.
        material: Material of the implant, if the registration had none.
        pitch_mm: Spacing of the nodes; that of the registration if None.
        result: Result of the run, if already read.

    Raises:
        ValueError: If the implant's material is unknown.
        FileNotFoundError: If the run is not finished, or one of its input files is missing.
    """
    result, files = result or read_run(run), read_config(Path(run) / "config.yaml").get("files") or {}
    meshes = [files["implant"]] if isinstance(files["implant"], str) else files["implant"]
    screws = None if components is None else read_components(components)
    if screws is not None and len(meshes) > 1:
        raise ValueError(f"run {run} has {len(meshes)} implants: screws cannot be named for all of them at once")
    components_in_world = []
    for implant, mesh in zip(result.implants, meshes, strict=True):
        try:
            implant_components = implant.known_components(
                read_mesh(mesh), screws=screws, material=material, pitch=pitch_mm or result.config.pitch_mm
            )
        except ValueError as error:
            raise ValueError(f"run {run}: {error} with --material") from None
        components_in_world += implant_components
    return components_in_world


@dataclass(frozen=True)
class ReconstructionInputs:
    """Inputs of a reconstruction.

    Attributes:
        geometry: All views.
        transmission: Measured intensity over that of the open beam (V, rows, cols); masked pixels are filled.
        mask: 0 for pixels without a measurement (V, rows, cols).
        grid: Voxel grid of the volume.
        beam: Beam model: energies and attenuation of the metals.
        scatter: Smooth scatter model, or scatter image in units of the open beam; None for no scatter.
        spectrum: Detected spectrum; a typical tungsten spectrum if no file gives it.
        estimate: Estimated beam, with `beam` "estimate"; else None.
        file: File from which views are streamed; `transmission` then holds a sample of the views. None if it holds all.
        components: Registered metal, in the world; empty except for "kcrec" and "kcmar".
        blur_sigma_px: Standard deviation of the imaging blur found by the registration, in pixels.
    """

    geometry: ConeBeamGeometry
    transmission: Tensor
    mask: Tensor
    grid: VolumeGrid
    beam: BeamModel
    scatter: Veil | Tensor | None
    spectrum: Spectrum
    components: list[KnownComponent]
    estimate: BeamEstimate | None = None
    file: ProjectionFile | None = None
    blur_sigma_px: float = 0.0

    def of_views(self, views: list[int]) -> ReconstructionInputs:
        """The inputs of some views, read from the file."""
        if self.file is None:
            raise ValueError("all views are already in memory")
        part = self.file.read(views)
        transmission = torch.exp(-filled(part.line_integrals, part.mask))
        return replace(self, geometry=self.geometry.select(views), transmission=transmission, mask=part.mask, file=None)

    def scatter_in_words(self) -> dict[str, float] | None:
        """Summary of the scatter for the metrics; None for no scatter."""
        if self.scatter is None:
            return None
        if isinstance(self.scatter, Veil):
            return {"fraction": self.scatter.fraction, "sigma_mm": self.scatter.sigma_mm}
        return {"mean_of_run": float(self.scatter.mean())}

    def read(self, views: list[int]) -> tuple[Tensor, Tensor]:
        """Transmission and mask (v, rows, cols) of some views, read from the file."""
        part = self.of_views(views)
        return part.transmission, part.mask


def read_reconstruction_inputs(files: ReconstructionFiles, options: ReconstructionOptions) -> ReconstructionInputs:
    """Read and check the inputs of a reconstruction, without writing anything.

    Raises:
        ValueError: If files are malformed or do not fit together, or a file is named neither by flag nor by run.
        FileNotFoundError: If a file is missing.
    """
    files = _completed(files)
    if files.geometry is None or files.projections is None:
        raise ValueError("a reconstruction needs geometry and projections, or a run that names them")
    geometry = read_geometry(files.geometry, projections=files.projections)
    file = _file(files.projections, files.open_beam, geometry, options) if options.stream else None
    if file is None:
        projections, sample_geometry = read_projections(files.projections, open_beam=files.open_beam), geometry
    else:
        sample = sorted({round(i * (len(file) - 1) / (SAMPLE_VIEWS - 1)) for i in range(SAMPLE_VIEWS)})
        projections, sample_geometry = file.read(sample), geometry.select(sample)
    projections.check_against(sample_geometry)
    components, material_name, result = [], options.material, None
    if options.method in ("kcrec", "kcmar"):
        if files.run is None:
            raise ValueError(f"method {options.method} needs the run of a registration: name it with --run")
        result = read_run(files.run)
        material_name = options.material or result.implants[0].material
        assumed_material = ALLOYS[0] if options.beam == "estimate" and material_name is None else options.material
        components = registered_components(
            files.run, components=files.components, material=assumed_material, result=result
        )
    elif options.beam != "given":
        raise ValueError(f"beam {options.beam} needs known metal: use method kcrec or kcmar, not {options.method}")
    if options.refine > 1 and options.method != "kcrec":
        raise ValueError(f"voxels are divided near known metal: use method kcrec, not {options.method}")
    if options.soft_tissue is not None and options.beam != "estimate":
        raise ValueError("soft tissue fixes the scale of an estimated beam: it needs beam estimate")
    if options.beam != "given" and options.monoenergetic:
        raise ValueError(f"monoenergetic cannot be combined with beam {options.beam}: leave one of the two out")
    if options.is_filtered and files.initial is not None:
        raise ValueError(f"an initial volume has no effect on {options.method}: use method pwls or kcrec")
    spectrum = read_spectrum(files.spectrum) if files.spectrum is not None else None
    if options.single_material is not None:
        material(options.single_material)
        if options.method != "fdk":
            raise ValueError(f"a single material needs method fdk, not {options.method}")
    if options.scatter == "run" and files.run is None:
        raise ValueError("scatter run needs the run of a registration: name it with --run")
    if (note := projections.masked_note()) is not None:
        warnings.warn(f"projections file {files.projections}: {note}", stacklevel=2)
    transmission = torch.exp(-filled(projections.line_integrals, projections.mask))
    scatter: Veil | Tensor | None
    if options.scatter == "run" and files.run is not None:
        scatter = (result or read_run(files.run)).scatter(transmission, geometry, mask=projections.mask)
    else:
        scatter = _scatter(
            transmission, projections.mask, sample_geometry, options, saturated=projections.num_saturated > 0
        )
    grid, estimate = _grid(geometry, options), None
    if options.beam == "estimate":

        def estimated(alloys: tuple[str, ...] = ()) -> BeamEstimate:
            return estimate_beam(
                transmission,
                geometry,
                grid,
                components,
                spectrum=spectrum,
                scatter=scatter,
                mask=projections.mask,
                alloys=alloys,
                soft_tissue=options.soft_tissue,
                progress=None,
                backend=options.backend,
            )

        estimate = estimated(() if material_name else ALLOYS)
        alloy_of = dict(zip(known_materials(components), estimate.alloys, strict=True))
        components = [replace(component, material=alloy_of[component.material]) for component in components]
        if len(set(estimate.alloys)) < len(estimate.alloys):  # metals of the same alloy share one factor: fit again
            estimate = estimated()
    return ReconstructionInputs(
        geometry,
        transmission,
        projections.mask,
        grid,
        _beam(spectrum, options, components, result) if estimate is None else estimate.beam,
        scatter,
        spectrum or tungsten_spectrum(),
        components,
        estimate,
        file,
        0.0 if result is None else result.blur_mm / math.sqrt(math.prod(geometry.pixel_spacing)),
    )


def _file(
    path: Path, open_beam: float | None, geometry: ConeBeamGeometry, options: ReconstructionOptions
) -> ProjectionFile:
    if options.scatter == "run" or options.beam == "estimate":
        raise ValueError("scatter run and beam estimate need all views at once: leave out stream")
    file = ProjectionFile(path, open_beam=open_beam)
    if len(file) != geometry.num_views:
        raise ValueError(f"projections file {path} has {len(file)} views, the geometry has {geometry.num_views}")
    return file


def _completed(files: ReconstructionFiles) -> ReconstructionFiles:
    """The files, with missing ones taken from the run."""
    if files.run is None:
        return files
    record = read_config(files.run / "config.yaml").get("files") or {}
    names = ("geometry", "projections", "spectrum")
    paths = {name: getattr(files, name) or (Path(record[name]) if record.get(name) else None) for name in names}
    open_beam = files.open_beam
    named = record.get("projections")
    if open_beam is None and (files.projections is None or (named and files.projections.resolve() == Path(named))):
        open_beam = record.get("open_beam")
    return ReconstructionFiles(
        run=files.run, components=files.components, open_beam=open_beam, initial=files.initial, **paths
    )


def _grid(geometry: ConeBeamGeometry, options: ReconstructionOptions) -> VolumeGrid:
    if options.size_mm is None:
        return field_of_view_grid(geometry, options.spacing_mm)
    if min(options.size_mm) <= 0:
        raise ValueError(f"size_mm must be positive, got {options.size_mm}")
    shape = [max(1, round(size / options.spacing_mm)) for size in reversed(options.size_mm)]
    return VolumeGrid.centered(shape, options.spacing_mm, center=options.center_mm)


def _beam(
    spectrum: Spectrum | None,
    options: ReconstructionOptions,
    components: list[KnownComponent],
    result: RegistrationResult | None,
) -> BeamModel:
    metals = [material(name) for name in known_materials(components)]
    if options.monoenergetic or (spectrum is None and not components):
        energy = (spectrum or tungsten_spectrum()).mean_energy
        water = float(material("water").attenuation((energy,))[0])
        return BeamModel.monoenergetic([float(m.attenuation((energy,))[0]) for m in metals], water=water)
    assumed_spectrum = spectrum or tungsten_spectrum()
    if options.beam == "run" and result is not None:
        hardened = Beam.of(metals, assumed_spectrum).behind(result.intensity.get("hardness", 0.0), range(len(metals)))
        return BeamModel.behind(hardened, reference_kev=assumed_spectrum.mean_energy)
    return BeamModel.polyenergetic(metals, assumed_spectrum)


def _scatter(
    transmission: Tensor, mask: Tensor, geometry: ConeBeamGeometry, options: ReconstructionOptions, *, saturated: bool
) -> Veil | None:
    if options.scatter == "none":
        return None
    if options.scatter != "auto":
        return Veil(float(options.scatter), options.scatter_sigma_mm)
    usable = mask.bool()
    if saturated:  # a saturated pixel is only a lower bound of the intensity
        usable = usable & (transmission < 0.9999 * transmission.max())
    return fit_veil(transmission, geometry.pixel_spacing, mask=usable)

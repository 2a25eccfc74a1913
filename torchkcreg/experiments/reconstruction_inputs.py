"""What a reconstruction is made from: files, options, and what they hold."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from torchkcreg.config import Config
from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.io import read_config, read_geometry, read_projections, read_run, read_spectrum
from torchkcreg.physics import Spectrum, material, tungsten_spectrum
from torchkcreg.reconstruction import (
    BeamEstimate,
    BeamModel,
    KnownComponent,
    Veil,
    estimate_beam,
    field_of_view_grid,
    filled,
    fit_veil,
    known_materials,
)

from .registered_components import registered_components

ALLOYS = ("titanium", "steel", "cocr")  # of which an implant is that nobody named


@dataclass(frozen=True)
class ReconstructionFiles:
    """The files of a reconstruction; what is not given comes from the run.

    Attributes:
        run: Folder of a finished registration: the implant in its place.
        geometry: Projection matrices.
        projections: Intensities or line integrals of all views.
        spectrum: Detected spectrum.
        components: Screws to take instead of the run's.
        open_beam: Unattenuated intensity where the projections' file does not say it.
        initial: Volume to start PWLS from.
    """

    run: Path | None = None
    geometry: Path | None = None
    projections: Path | None = None
    spectrum: Path | None = None
    components: Path | None = None
    open_beam: float | None = None
    initial: Path | None = None


class ReconstructionOptions(Config):
    """Options of a reconstruction; unknown keys are refused.

    Attributes:
        method: "fdk"; "pwls"; "kcrec", PWLS of what the registered implant leaves.
        spacing_mm: Edge of a voxel.
        size_mm: Size (x, y, z) of the volume; the field of view if None.
        center_mm: Its middle (x, y, z), where a size is given.
        preset: "momentum" or "paper" (500 iterations of 20 subsets).
        iterations: Overrides the preset's.
        subsets: Overrides the preset's.
        beta: Weight of the roughness.
        passes: Of the iterative methods; from the second on, mineral's hardening and the scatter in the metal's shadow
            are known from the pass before. None: two of "kcrec", which needs both, one of "pwls".
        window: Of the ramp.
        scatter: "auto" fits a smooth one to the air around the object; "run" is what the registration found, of both
            kinds; "none"; or its fraction of the primary.
        scatter_sigma_mm: How broad a given fraction's scatter is.
        monoenergetic: One energy, as in the paper, even where a spectrum is known.
        beam: "given" is the spectrum of the file and the materials of the run, or a likely one; "estimate" is what the
            metal's shadow tells of a spectrum, or an implant's material, that nobody knows (methods with components).
        material: The implant's, where the registration had none.
        single_material: What the object is of, where it is of one material alone, such as an implant on a bench: "fdk"
            gives the share of it in each voxel, without beam hardening.
        backend: Projector: "auto", "cpp" or "torch".
    """

    method: Literal["fdk", "pwls", "kcrec", "kcmar"] = "fdk"
    spacing_mm: float = Field(0.8, gt=0)
    size_mm: tuple[float, float, float] | None = None
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    preset: Literal["momentum", "paper"] = "momentum"
    iterations: int | None = Field(None, ge=1)
    subsets: int | None = Field(None, ge=1)
    beta: float = Field(10.0, ge=0)
    passes: int | None = Field(None, ge=1)
    window: Literal["ram-lak", "shepp-logan", "cosine", "hamming", "hann"] = "hann"
    scatter: Literal["auto", "run", "none"] | float = "auto"
    scatter_sigma_mm: float = Field(40.0, gt=0)
    monoenergetic: bool = False
    beam: Literal["given", "estimate"] = "given"
    material: str | None = None
    single_material: str | None = None
    backend: Literal["auto", "cpp", "torch"] = "auto"

    @property
    def is_filtered(self) -> bool:
        """Whether it is a filtered back-projection, without iterations."""
        return self.method in ("fdk", "kcmar")

    @property
    def num_passes(self) -> int:
        """Passes that are made."""
        if self.passes is not None:
            return self.passes
        return 2 if self.method == "kcrec" else 1


@dataclass(frozen=True)
class ReconstructionInputs:
    """What files and options amount to.

    Attributes:
        geometry: All views.
        transmission: Measured intensity over the open beam's, (V, rows, cols); masked pixels filled.
        mask: 0 where a pixel holds no measurement.
        grid: The voxels.
        beam: Energies and the metals' attenuation.
        scatter: Smooth scatter, or an image of it in units of the open beam; None for none.
        spectrum: As detected; a likely one where no file says it.
        estimate: What was estimated of the beam, where that was asked for.
        components: The metal in its place; none but for "kcrec" and "kcmar".
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


def read_reconstruction_inputs(files: ReconstructionFiles, options: ReconstructionOptions) -> ReconstructionInputs:
    """The inputs of a reconstruction; nothing is written.

    Raises:
        ValueError: Files that are malformed or don't fit together, or a file that neither flag nor run names.
        FileNotFoundError: A file is missing.
    """
    files = _completed(files)
    if files.geometry is None or files.projections is None:
        raise ValueError("a reconstruction needs geometry and projections, or a run that names them")
    geometry = read_geometry(files.geometry)
    projections = read_projections(files.projections, open_beam=files.open_beam)
    projections.check_against(geometry)
    components, named = [], options.material
    if options.method in ("kcrec", "kcmar"):
        if files.run is None:
            raise ValueError(f"method {options.method} needs the run of a registration: name it with --run")
        named = options.material or read_run(files.run).implants[0].material
        likely = ALLOYS[0] if options.beam == "estimate" and named is None else options.material
        components = registered_components(files.run, components=files.components, material=likely)
    elif options.beam == "estimate":
        raise ValueError(f"a beam is estimated behind known metal, which kcrec and kcmar have, not {options.method}")
    if options.beam == "estimate" and options.monoenergetic:
        raise ValueError("a beam of one energy cannot be estimated: leave out monoenergetic, or the estimate")
    spectrum = read_spectrum(files.spectrum) if files.spectrum is not None else None
    if options.single_material is not None:
        material(options.single_material)
        if options.method != "fdk":
            raise ValueError(f"a single material goes with method fdk, not {options.method}")
    if options.scatter == "run" and files.run is None:
        raise ValueError("scatter as a registration found it needs its run: name it with --run")
    if (note := projections.masked_note()) is not None:
        warnings.warn(f"projections file {files.projections}: {note}", stacklevel=2)
    transmission = torch.exp(-filled(projections.line_integrals, projections.mask))
    scatter: Veil | Tensor | None
    if options.scatter == "run" and files.run is not None:
        scatter = read_run(files.run).scatter(transmission, geometry, mask=projections.mask)
    else:
        scatter = _scatter(transmission, projections.mask, geometry, options, saturated=projections.num_saturated > 0)
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
                backend=options.backend,
            )

        if named is None:
            found = dict(zip(known_materials(components), estimated(ALLOYS).alloys, strict=True))
            components = [replace(component, material=found[component.material]) for component in components]
        estimate = estimated()
    return ReconstructionInputs(
        geometry,
        transmission,
        projections.mask,
        grid,
        _beam(spectrum, options, components) if estimate is None else estimate.beam,
        scatter,
        spectrum or tungsten_spectrum(),
        components,
        estimate,
    )


def _completed(files: ReconstructionFiles) -> ReconstructionFiles:
    """Files with those that the run was made from where none are given."""
    if files.run is None:
        return files
    record = read_config(files.run / "config.yaml").get("files") or {}
    names = ("geometry", "projections", "spectrum")
    own = {name: getattr(files, name) or (Path(record[name]) if record.get(name) else None) for name in names}
    open_beam = files.open_beam if files.open_beam is not None else record.get("open_beam")
    return ReconstructionFiles(
        run=files.run, components=files.components, open_beam=open_beam, initial=files.initial, **own
    )


def _grid(geometry: ConeBeamGeometry, options: ReconstructionOptions) -> VolumeGrid:
    if options.size_mm is None:
        return field_of_view_grid(geometry, options.spacing_mm)
    if min(options.size_mm) <= 0:
        raise ValueError(f"size_mm must be positive, got {options.size_mm}")
    shape = [max(1, round(size / options.spacing_mm)) for size in reversed(options.size_mm)]
    return VolumeGrid.centered(shape, options.spacing_mm, center=options.center_mm)


def _beam(spectrum: Spectrum | None, options: ReconstructionOptions, components: list[KnownComponent]) -> BeamModel:
    metals = [material(name) for name in known_materials(components)]
    if options.monoenergetic or (spectrum is None and not components):
        energy = (spectrum or tungsten_spectrum()).mean_energy
        water = float(material("water").attenuation((energy,))[0])
        return BeamModel.monoenergetic([float(m.attenuation((energy,))[0]) for m in metals], water=water)
    return BeamModel.polyenergetic(metals, spectrum or tungsten_spectrum())


def _scatter(
    transmission: Tensor, mask: Tensor, geometry: ConeBeamGeometry, options: ReconstructionOptions, *, saturated: bool
) -> Veil | None:
    if options.scatter == "none":
        return None
    if options.scatter != "auto":
        return Veil(float(options.scatter), options.scatter_sigma_mm)
    usable = mask.bool()
    if saturated:  # a full pixel says only that there is at least as much
        usable = usable & (transmission < 0.9999 * transmission.max())
    return fit_veil(transmission, geometry.pixel_spacing, mask=usable)

"""The input files of a registration, read and checked against each other."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.implant import Component, ImplantPointCloud, find_holes
from torchkcreg.io import (
    read_components,
    read_config,
    read_geometry,
    read_init,
    read_mesh,
    read_projections,
    read_run,
    read_spectrum,
)
from torchkcreg.kernels import choose_backend
from torchkcreg.mechanics import num_shells, separate_bodies
from torchkcreg.physics import Spectrum, material
from torchkcreg.plain import first_line
from torchkcreg.registration import Implant, RegisteredImplant, RegistrationConfig
from torchkcreg.registration.implant import bends_elastically
from torchkcreg.scene import RegistrationData
from torchkcreg.search import spread_views

MOST_VIEWS = 24  # more take longer, and what the model has wrong in all of them stays
RECORD_KEYS = {"files", "options", "schedule"}  # of a run's config.yaml
_FEWEST_NODES_ALONG = 4
_SAME_FRAME_MM = 5.0  # tolerance between bounds of nodes and mesh: nodes do not reach the surface
_FEWEST_PIXELS = 4  # along the detector's shorter side, after binning


@dataclass(frozen=True)
class ImplantFiles:
    """Files of one implant, see `torchkcreg.commands.RegistrationFiles`."""

    name: str
    mesh: Path
    components: Path | None = None
    init: Path | None = None
    rest: Path | None = None
    material: str | None = None


def read_implant(files: ImplantFiles, config: RegistrationConfig) -> Implant:
    """Read one implant of a registration.

    Raises:
        ValueError: If a file is malformed.
        FileNotFoundError: If a file is missing.
    """
    screws = read_components(files.components) if files.components else []
    mesh = read_mesh(files.mesh)
    rest = _registered(files.rest, files, mesh) if files.rest else None
    pose = _start_pose(files, mesh)
    if files.init is None and rest is not None:
        pose = rest.implant_to_world
    _check_size(files.mesh, mesh, config.pitch_mm)
    if bends_elastically(config, files.material) and (number := num_shells(mesh)) > 1:
        raise ValueError(f"mesh file {files.mesh}: {separate_bodies(number)}")
    return Implant(
        ImplantPointCloud.from_mesh(mesh, config.pitch_mm),
        components=[Component.of(screw, pitch=config.pitch_mm) for screw in screws],
        holes=find_holes(mesh),
        implant_to_world=pose,
        material=files.material,
        name=files.name,
        rest=rest,
    )


def _start_pose(files: ImplantFiles, mesh: trimesh.Trimesh) -> Tensor | None:
    """Start pose from a file, or from the same implant in another registration's run folder; None for no file."""
    if files.init is None or not files.init.is_dir():
        return read_init(files.init) if files.init else None
    return _registered(files.init, files, mesh).implant_to_world


def _registered(folder: Path, files: ImplantFiles, mesh: trimesh.Trimesh) -> RegisteredImplant:
    """The same implant in the run folder of another registration."""
    implants = read_run(folder).implants
    implant = next((i for i in implants if i.name == files.name), implants[0])
    if implant.deviations is not None:
        nodes, bounds = implant.deviations.points, torch.from_numpy(np.array(mesh.bounds))
        off = float((torch.stack([nodes.amin(0), nodes.amax(0)]) - bounds).abs().max())
        if off > _SAME_FRAME_MM:
            raise ValueError(
                f"the implant of run folder {folder} reaches up to {off:.0f} mm further than {files.mesh}: another "
                "implant, or another frame"
            )
    return implant


def _check_size(path: Path, mesh: trimesh.Trimesh, pitch_mm: float) -> None:
    if mesh.extents.max() < _FEWEST_NODES_ALONG * pitch_mm:
        size = " x ".join(f"{extent:.3g}" for extent in mesh.extents)
        raise ValueError(
            f"the implant in {path} is {size} mm, too small for nodes {pitch_mm:g} mm apart: is the mesh in metres?"
        )


@dataclass(frozen=True)
class RegistrationFiles:
    """Input files of a registration. With several implants, the files per implant are lists (None: no file).

    Attributes:
        implant: Closed mesh of the undeformed implant, mm.
        geometry: Projection matrices.
        projections: Intensities or line integrals.
        spectrum: Detected spectrum; if None and a material is named, a 90 kV tungsten spectrum is used.
        components: Screws that move with the implant.
        init: Approximate pose, or run folder of another registration of the implant.
        rest: Run folder of a registration of the implant without load; its shape is the rest shape of the finite
            elements.
        materials: Material of each implant, if they differ.
        views: Views to use, or "all"; None for all of up to 24, or of more the 24 that lie furthest apart.
        open_beam: Unattenuated intensity, if the projections' file does not give it.
        config: Options as YAML or JSON.
    """

    implant: Path | Sequence[Path]
    geometry: Path
    projections: Path
    spectrum: Path | None = None
    components: Path | Sequence[Path | None] | None = None
    init: Path | Sequence[Path | None] | None = None
    rest: Path | Sequence[Path | None] | None = None
    materials: Sequence[str] | None = None
    views: list[int] | Literal["all"] | None = None
    open_beam: float | None = None
    config: Path | None = None

    @property
    def view_list(self) -> list[int] | None:
        """Views to use; None for all."""
        return self.views if isinstance(self.views, list) else None

    def with_views(self) -> RegistrationFiles:
        """The files with a list of views, if all are asked for, or if there are more than are of use."""
        if isinstance(self.views, list):
            return self
        geometry = read_geometry(self.geometry, projections=self.projections)
        if self.views == "all":
            return replace(self, views=list(range(geometry.num_views)))
        if geometry.num_views <= MOST_VIEWS:
            return self
        return replace(self, views=spread_views(geometry, MOST_VIEWS, opposite=True))

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> RegistrationFiles:
        """The given files; what is None is taken from the `config.yaml` of a run, if that is the options' file.

        Raises:
            ValueError: If implant, geometry or projections are named neither way.
        """
        options = read_config(given["config"]) if given.get("config") else {}
        recorded = options.get("files") if options.keys() == RECORD_KEYS else None
        files = {key: _path(key, value) for key, value in (recorded or {}).items() if key in cls.__dataclass_fields__}
        files |= {key: value for key, value in given.items() if value is not None}
        if files.get("views") == "auto":
            files["views"] = None
        if missing := [f"--{name}" for name in ("implant", "geometry", "projections") if files.get(name) is None]:
            raise ValueError(f"a registration needs {', '.join(missing)} (or --config with the config.yaml of a run)")
        return cls(**files)

    def each(self) -> list[ImplantFiles]:
        """Files of each implant.

        Raises:
            ValueError: If a list of files is not as long as that of implants, or two meshes share a name.
        """
        meshes = [self.implant] if isinstance(self.implant, Path) else list(self.implant)
        names = [mesh.stem for mesh in meshes] if len(meshes) > 1 else ["implant"]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            times = names.count(twice[0])
            raise ValueError(f"implants are named after their files, but {twice[0]} is there {times} times")
        return [
            ImplantFiles(*entries)
            for entries in zip(
                names,
                meshes,
                _for_each(self.components, len(meshes), "components"),
                _for_each(self.init, len(meshes), "init"),
                _for_each(self.rest, len(meshes), "rest"),
                _for_each(self.materials, len(meshes), "material"),
                strict=True,
            )
        ]


def _path(key: str, value: Any) -> Any:
    """A recorded value with its texts as paths, unless it names no file."""
    if key in ("views", "open_beam", "materials"):
        return value
    if isinstance(value, list):
        return [_path(key, item) for item in value]
    return Path(value) if isinstance(value, str) else value


def _for_each(paths: Any, number: int, kind: str) -> list[Any]:
    listed = [paths] if paths is None or isinstance(paths, (str, Path)) else list(paths)
    if paths is None:
        return [None] * number
    if len(listed) != number:
        raise ValueError(f"{number} implants need as many {kind}, got {len(listed)}; use - for none")
    return listed


@dataclass(frozen=True)
class RegistrationInputs:
    """Inputs of a registration, as read from its files.

    Attributes:
        implants: Each undeformed implant with its components, holes and start pose.
        data: Projections and geometry of the views to use.
        spectrum: Detected spectrum; None if not given.
        warnings: Warnings about the inputs, a line each.
    """

    implants: list[Implant]
    data: RegistrationData
    spectrum: Spectrum | None
    warnings: list[str]


def read_inputs(files: RegistrationFiles, config: RegistrationConfig) -> RegistrationInputs:
    """Read and check the inputs of a registration, without writing anything.

    Raises:
        ValueError: If a file is malformed, files do not fit together, or an option is not available on this machine.
        FileNotFoundError: If a file is missing.
    """
    _check_options(files, config)
    with _noted() as notes:
        each = files.each()
        data = _read_data(files, config)
        spectrum = read_spectrum(files.spectrum) if files.spectrum else None
        implants = [read_implant(implant, config) for implant in each]
    return RegistrationInputs(implants, data, spectrum, notes)


def _check_options(files: RegistrationFiles, config: RegistrationConfig) -> None:
    choose_backend(_device(config.device), config.backend)
    if config.material is not None:
        for name in (config.material, *(files.materials or ())):
            material(name)
    elif files.spectrum is not None:
        raise ValueError("a spectrum needs the implant's material: name it with --material")
    views = files.view_list or []
    if twice := sorted({view for view in views if views.count(view) > 1}):
        raise ValueError(f"views must be distinct, got view {twice[0]} {views.count(twice[0])} times")


def _device(name: str) -> Tensor:
    """An empty tensor on a device; ValueError if the device does not exist."""
    try:
        return torch.empty(0, device=name)
    except (RuntimeError, AssertionError, ValueError) as error:  # which one torch raises depends on the device
        reason = first_line(error)
        raise ValueError(f"device {name!r} is not available: {reason[:120]}") from error


def _read_data(files: RegistrationFiles, config: RegistrationConfig) -> RegistrationData:
    geometry = read_geometry(files.geometry, projections=files.projections)
    projections = read_projections(files.projections, open_beam=files.open_beam)
    projections.check_against(geometry)
    if files.view_list is not None:
        projections = (
            read_projections(files.projections, open_beam=files.open_beam, views=files.view_list)
            if projections.num_masked  # read again, to count masked pixels in these views only
            else projections.select(files.view_list)
        )
        geometry = geometry.select(files.view_list)
    if (note := projections.masked_note()) is not None:
        warnings.warn(f"projections file {files.projections}: {note}", stacklevel=2)
    largest = max(stage.bin for stage in config.schedule())
    if min(geometry.det_shape) < _FEWEST_PIXELS * largest:
        rows, cols = geometry.det_shape
        raise ValueError(f"the detector has {rows} x {cols} pixels, too few for a stage that bins {largest} into one")
    return RegistrationData(geometry, projections.line_integrals, projections.mask)


@contextmanager
def _noted() -> Iterator[list[str]]:
    """Collect the texts of a block's warnings, a line each, and issue each text once when the block ends or fails."""
    notes: list[str] = []
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield notes
    finally:
        texts = [" ".join(str(w.message).split()) for w in caught if issubclass(w.category, UserWarning)]
        notes.extend(dict.fromkeys(texts))
        for note in notes:
            warnings.warn(note, stacklevel=4)

"""The files of one implant of a registration, read and checked against each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.implant import Component, ImplantPointCloud, find_holes
from torchkcreg.io import read_components, read_init, read_mesh, read_run
from torchkcreg.registration import Implant, RegisteredImplant, RegistrationConfig

_FEWEST_NODES_ALONG = 4
_SAME_FRAME_MM = 5.0  # by which bounds of one implant may differ: nodes do not reach its surface


@dataclass(frozen=True)
class ImplantFiles:
    """The files of one implant, see :class:`torchkcreg.experiments.RegistrationFiles`."""

    name: str
    mesh: Path
    components: Path | None = None
    init: Path | None = None
    rest: Path | None = None
    material: str | None = None


def read_implant(files: ImplantFiles, config: RegistrationConfig) -> Implant:
    """One implant of a registration.

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
    """A pose out of a file, or that of the same implant in the run folder of another registration."""
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

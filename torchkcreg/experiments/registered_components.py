"""The metal of a finished registration in its place: bent plate and screws as known components."""

from __future__ import annotations

from pathlib import Path

import torch
import trimesh

from torchkcreg.evaluation import deformed_surface
from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud, Screw
from torchkcreg.io import read_components, read_config, read_mesh, read_run
from torchkcreg.reconstruction import KnownComponent
from torchkcreg.registration import RegistrationResult
from torchkcreg.scene import followed_points


def registered_components(
    run: Path, *, components: Path | None = None, material: str | None = None, pitch_mm: float | None = None
) -> list[KnownComponent]:
    """The implant of a run as it was registered, then its screws, in world mm.

    Args:
        run: folder of a finished registration.
        components: screws to take instead of those of the registration, which were given to it or which it found;
            each follows the implant near its head.
        material: the implant's, where the registration had none.
        pitch_mm: of the nodes; the registration's if None.

    Raises:
        ValueError: nothing says what the implant is made of.
        FileNotFoundError: the run is not finished, or a file it was made from is gone.
    """
    result, files, options = read_run(run), *_record(run)
    name = material or options.get("material")
    if name is None:
        raise ValueError(f"run {run} was registered without a material: name the implant's with --material")
    pitch = pitch_mm or float(options.get("pitch_mm", 0.25))
    mesh = read_mesh(files["implant"])
    known = [KnownComponent.from_mesh(deformed_surface(result, mesh, longest_edge_mm=2.0), name, pitch=pitch)]
    screws = read_components(components) if components is not None else result.implants[0].screws
    placed = [KnownComponent.from_mesh(_placed_screw(s, mesh, result), s.material, pitch=pitch) for s in screws]
    return [*known, *placed]


def _record(run: Path) -> tuple[dict, dict]:
    content = read_config(Path(run) / "config.yaml")
    return content.get("files") or {}, content.get("options") or {}


def _placed_screw(screw: Screw, mesh: trimesh.Trimesh, result: RegistrationResult) -> trimesh.Trimesh:
    motion = result.components.get(screw.name)
    if motion is None:
        nodes = ImplantPointCloud.from_mesh(mesh, 1.0, dtype=torch.float64).points
        near = followed_points(nodes, torch.tensor(screw.start, dtype=torch.float64), result.config.follow_radius_mm)
        pose = fit_rigid(near, result.warp(near))
    else:
        pose = result.implant_to_world.double() @ motion.double()
    own = screw.mesh()
    vertices = transform_points(pose, torch.from_numpy(own.vertices.copy()))
    return trimesh.Trimesh(vertices.numpy(), own.faces, process=False)

"""What the implant of a registration carries, out of its run folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import FiniteElementDeformation
from torchkcreg.io import implant_of_run, mesh_of_run, read_mesh, write_figure, write_json, write_surface_vtu
from torchkcreg.mechanics import CarriedLoad, node_stresses
from torchkcreg.plain import plain
from torchkcreg.registration import RegisteredImplant
from torchkcreg.visualization import load_figure

_EDGE_MM = 1.5


@dataclass(frozen=True, eq=False)
class ImplantLoad:
    """What an implant carries.

    Attributes:
        carried: Loads at holds and through sections.
        stress: Largest von Mises stress on its surface, N/mm^2.
        stress_std: Its standard deviation.
        yield_stress: Where the alloy begins to stay bent.
        warnings: Why it may not be so.
        folder: Where the files are.
    """

    carried: CarriedLoad
    stress: float
    stress_std: float
    yield_stress: float
    warnings: tuple[str, ...]
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, with units in their names."""
        return {
            **self.carried.to_dict(),
            "largest_stress_mpa": self.stress,
            "largest_stress_std_mpa": self.stress_std,
            "yield_stress_mpa": self.yield_stress,
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        moments, std = (x[:, 3:] for x in (self.carried.section_loads, self.carried.section_std))
        lines = []
        for axis, name in enumerate(("bending out of its plane", "bending in its plane", "torsion")):
            at = int(moments[:, axis].abs().argmax())
            told = f"{float(moments[at, axis]) / 1000:.2f} +- {float(std[at, axis]) / 1000:.2f} N m"
            lines.append(f"{name}: {told} at {float(self.carried.heights[at]):.0f} mm from the lower end")
        lines.append(f"von Mises stress: {self.stress:.0f} +- {self.stress_std:.0f} of {self.yield_stress:.0f} MPa")
        return "\n".join([*lines, *(f"warning: {text}" for text in self.warnings), f"folder {self.folder}"])


def load_files(
    run_folder: Path,
    out: Path,
    *,
    against: Path | None = None,
    implant: Path | None = None,
    name: str | None = None,
    figures: bool = True,
) -> ImplantLoad:
    """Loads of the implant of a finished registration with finite elements; writes JSON, VTU and a figure.

    Args:
        run_folder: Folder of the registration.
        out: Folder for `load.json`, `load.vtu` and `load.png`; it is made.
        against: Folder of a registration of the same implant without load: what both have in common (it was bent
            before it was implanted, or is not quite what the mesh says) is no load.
        implant: Mesh of the undeformed implant; the one that the run was started with when None.
        name: Of several implants, which.
        figures: Whether to draw.

    Raises:
        ValueError: If a run is not one with finite elements, or the two are of different implants.
        FileNotFoundError: If a file is missing.
    """
    result, registered = implant_of_run(run_folder, name)
    own = _elastic(registered, run_folder)
    amounts, covariance = own.amounts.detach(), own.covariance
    warnings = [f"the registration is {result.status}: {why}" for why in result.warnings if result.status != "ok"]
    if against is not None:
        other = _elastic(implant_of_run(against, name)[1], against)
        _require_same(own, other)
        amounts = amounts - other.amounts.detach()
        covariance = None if covariance is None or other.covariance is None else covariance + other.covariance
    element = own.superelement
    mesh = read_mesh(implant or mesh_of_run(run_folder, result.implants.index(registered)))
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _EDGE_MM)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    known = own.expected.covariance if covariance is None else covariance
    rested = own.rested(points)
    stress, std = node_stresses(element, rested, amounts, known)
    worst, limit = int(stress.argmax()), element.constants.yield_stress
    if float(stress[worst]) > limit:
        unloaded = against is not None or own.rest is not None
        hint = "" if unloaded else "; a run without load takes that out: load --against it, or register --rest"
        warnings.append(
            f"stress reaches {float(stress[worst]):.0f} MPa, more than the {limit:.0f} MPa where the alloy yields: the "
            f"implant {'stays bent' if unloaded else 'was bent before, or stays so,'} beyond this load{hint}"
        )
    found = ImplantLoad(
        CarriedLoad.of(element, amounts, covariance, own.expected),
        float(stress[worst]),
        float(std[worst]),
        limit,
        tuple(warnings),
        out,
    )
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "load.json", plain(found.to_dict()))
    placed = mesh.copy()
    placed.vertices = registered.warp(points).numpy()
    values = {"von_mises_mpa": stress, "von_mises_std_mpa": std, "displacement_mm": registered.displacement(points)}
    write_surface_vtu(out / "load.vtu", placed, values)
    if figures:
        title = f"what the {registered.name} carries"
        figure = load_figure(found.carried, rested, stress, yield_stress=limit, title=title)
        write_figure(out / "load.png", figure)
    return found


def _elastic(implant: RegisteredImplant, folder: Path) -> FiniteElementDeformation:
    if not isinstance(implant.deformation, FiniteElementDeformation):
        raise ValueError(
            f"run folder {folder} was registered with --deformation {implant.deformation.model}, which knows no loads: "
            "register with --deformation fe"
        )
    return implant.deformation


def _require_same(own: FiniteElementDeformation, other: FiniteElementDeformation) -> None:
    ours, theirs = own.superelement, other.superelement
    if ours.holds != theirs.holds or ours.constants != theirs.constants or not _alike(ours.loads, theirs.loads):
        raise ValueError("the two runs are of different implants, materials or holds: their loads cannot be compared")


def _alike(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.allclose(one, other, rtol=1e-4, atol=1e-4)

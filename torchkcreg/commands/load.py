"""Loads and stresses of a registered implant, from its run folder."""

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
    """Loads and stresses of an implant.

    Attributes:
        carried: Loads at its holds and through its cross-sections.
        stress: Largest von Mises stress on its surface, N/mm^2.
        stress_std: Standard deviation of the largest stress, N/mm^2.
        yield_stress: Yield stress of the alloy, N/mm^2.
        warnings: Reasons to doubt the loads.
        folder: Output folder.
    """

    carried: CarriedLoad
    stress: float
    stress_std: float
    yield_stress: float
    warnings: tuple[str, ...]
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain types and tensors, with units in the keys."""
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
            value = f"{float(moments[at, axis]) / 1000:.2f} +- {float(std[at, axis]) / 1000:.2f} N m"
            lines.append(f"{name}: {value} at {float(self.carried.heights[at]):.0f} mm from the lower end")
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
    """Estimate the loads of a registered implant from its finite elements; write JSON, VTU and a figure.

    Args:
        run_folder: Folder of a finished registration.
        out: Folder for `load.json`, `load.vtu` and `load.png`, created if missing.
        against: Folder of a registration of the same implant without load. Its deformation (bent before implantation,
            or a mesh that differs from the implant) is subtracted, because it is no load.
        implant: Mesh of the undeformed implant; the run's mesh if None.
        name: Name of the implant, if the run has several.
        figures: Draw the figure.

    Raises:
        ValueError: If a run did not use finite elements, or the two runs are of different implants.
        FileNotFoundError: If a file is missing.
    """
    result, registered = implant_of_run(run_folder, name)
    loaded = _elastic(registered, run_folder)
    amounts, covariance = loaded.amounts.detach(), loaded.covariance
    warnings = [f"the registration is {result.status}: {why}" for why in result.warnings if result.status != "ok"]
    if against is not None:
        unloaded_state = _elastic(implant_of_run(against, name)[1], against)
        _require_same(loaded, unloaded_state)
        amounts = amounts - unloaded_state.amounts.detach()
        covariance = (
            None if covariance is None or unloaded_state.covariance is None else covariance + unloaded_state.covariance
        )
    element = loaded.superelement
    mesh = read_mesh(implant or mesh_of_run(run_folder, result.implants.index(registered)))
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _EDGE_MM)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    uncertainty = loaded.expected.covariance if covariance is None else covariance
    rest_points = loaded.rested(points)
    stress, std = node_stresses(element, rest_points, amounts, uncertainty)
    worst, limit = int(stress.argmax()), element.constants.yield_stress
    if float(stress[worst]) > limit:
        unloaded = against is not None or loaded.rest is not None
        hint = "" if unloaded else "; a run without load removes that: load --against it, or register --rest"
        warnings.append(
            f"stress reaches {float(stress[worst]):.0f} MPa, above the alloy's yield stress of {limit:.0f} MPa: the "
            f"implant {'stays bent' if unloaded else 'was bent before, or stays bent,'} after this load{hint}"
        )
    load = ImplantLoad(
        CarriedLoad.of(element, amounts, covariance, loaded.expected),
        float(stress[worst]),
        float(std[worst]),
        limit,
        tuple(warnings),
        out,
    )
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "load.json", plain(load.to_dict()))
    placed = mesh.copy()
    placed.vertices = registered.warp(points).numpy()
    values = {"von_mises_mpa": stress, "von_mises_std_mpa": std, "displacement_mm": registered.displacement(points)}
    write_surface_vtu(out / "load.vtu", placed, values)
    if figures:
        title = f"loads of the {registered.name}"
        figure = load_figure(load.carried, rest_points, stress, yield_stress=limit, title=title)
        write_figure(out / "load.png", figure)
    return load


def _elastic(implant: RegisteredImplant, folder: Path) -> FiniteElementDeformation:
    if not isinstance(implant.deformation, FiniteElementDeformation):
        raise ValueError(
            f"run folder {folder} has no loads: its implant was not registered as finite elements; "
            "register with --deformation fe"
        )
    return implant.deformation


def _require_same(loaded: FiniteElementDeformation, unloaded: FiniteElementDeformation) -> None:
    first, second = loaded.superelement, unloaded.superelement
    if first.holds != second.holds or first.constants != second.constants or not _alike(first.loads, second.loads):
        raise ValueError("the two runs are of different implants, materials or holds: their loads cannot be compared")


def _alike(first: Tensor, second: Tensor) -> bool:
    return first.shape == second.shape and torch.allclose(first, second, rtol=1e-4, atol=1e-4)

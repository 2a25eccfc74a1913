"""Relative motion of a fracture's fragments between registrations, from their run folders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchkcreg.evaluation import AXES, RelativeMotion, fracture_plane, fragments_of, frame_changes, relative_motion
from torchkcreg.geometry import transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import implant_of_run, mesh_of_run, read_mesh, write_figure, write_json, write_text
from torchkcreg.plain import plain, std_key
from torchkcreg.registration import RegisteredImplant
from torchkcreg.visualization import comparison_figure

from .report import write_report

_PITCH_MM = 1.0
_COLUMNS = tuple(
    f"{what}_{axis.replace(' ', '_')}_{unit}"
    for what, unit in (("rotation", "deg"), ("translation", "mm"))
    for axis in AXES
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Motion of the upper fragment relative to the lower one, from an unloaded registration to loaded ones.

    Attributes:
        names: Folders of the loaded runs.
        motions: Motion in each loaded run.
        loads: Load of each loaded run, N; empty if not given.
        compliance: Rotations (degrees) and translations (mm) per newton (6,); None without loads.
        compliance_std: Standard deviations of the compliance (6,).
        warnings: Reasons to doubt the motions.
        folder: Output folder.
    """

    names: tuple[str, ...]
    motions: tuple[RelativeMotion, ...]
    loads: tuple[float, ...]
    compliance: Tensor | None
    compliance_std: Tensor | None
    warnings: tuple[str, ...]
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain types and tensors, with units in the keys."""
        runs = [{"run": name, **motion.to_dict()} for name, motion in zip(self.names, self.motions, strict=True)]
        for run, load in zip(runs, self.loads):
            run["load_n"] = load
        content = {"runs": runs, "warnings": list(self.warnings)}
        if self.compliance is not None and self.compliance_std is not None:
            slopes = zip(_COLUMNS, self.compliance.tolist(), self.compliance_std.tolist(), strict=True)
            content["compliance_per_n"] = {name: {"value": value, "std": std} for name, value, std in slopes}
        return content

    def table(self) -> str:
        """CSV table with a row per loaded run."""
        heads = ["run", *(["load_n"] if self.loads else [])]
        heads += [column for name in _COLUMNS for column in (name, std_key(name))]
        lines = [",".join(heads)]
        for number, (name, motion) in enumerate(zip(self.names, self.motions, strict=True)):
            pairs = torch.stack(motion.numbers, dim=1).flatten().tolist()
            load = [f"{self.loads[number]:g}"] if self.loads else []
            lines.append(",".join([name, *load, *(f"{value:.5f}" for value in pairs)]))
        return "\n".join(lines) + "\n"

    def __str__(self) -> str:
        parts = [f"{name}\n{motion}" for name, motion in zip(self.names, self.motions, strict=True)]
        if self.compliance is not None and self.compliance_std is not None:
            steepest = int(self.compliance[:3].abs().argmax())
            slope, std = 1000 * float(self.compliance[steepest]), 1000 * float(self.compliance_std[steepest])
            name = _COLUMNS[steepest].removesuffix("_deg").replace("_", " ")
            parts.append(f"{name}: {slope:.3f} +- {std:.3f} degrees per kN")
        return "\n".join([*parts, *(f"warning: {text}" for text in self.warnings), f"folder {self.folder}"])


def compare_files(
    unloaded: Path,
    loaded: Sequence[Path],
    out: Path,
    *,
    loads: Sequence[float] = (),
    plane: Sequence[float] | None = None,
    fragment: Path | None = None,
    name: str | None = None,
    figures: bool = True,
) -> Comparison:
    """Measure how a fracture's fragments move under load between registrations; write JSON, CSV and a figure.

    Args:
        unloaded: Run folder of the registration without load.
        loaded: Run folders of the registrations under load; their meshes may be in other CAD frames.
        out: Folder for `compare.json`, `compare.csv` and `compare.png`, created if missing.
        loads: Load of each loaded run, N.
        plane: Fracture plane in the implant's frame of the unloaded run: point, or point and normal (3 or 6 numbers).
        fragment: Surface mesh of one fragment in that frame.
        name: Name of the implant, if the runs have several.
        figures: Draw figure and report.

    Raises:
        ValueError: If runs are of different implants, or the fragments cannot be determined.
        FileNotFoundError: If a file is missing.
    """
    if not loaded:
        raise ValueError("nothing to compare with: name a loaded run, or several")
    if loads and len(loads) != len(loaded):
        raise ValueError(f"{len(loaded)} loaded runs need as many loads, got {len(loads)}")
    if loads and (not all(math.isfinite(load) for load in loads) or not any(loads)):
        given = ", ".join(f"{load:g}" for load in loads)
        raise ValueError(f"loads must be finite, and one of them other than 0 N, got {given}")
    if plane is not None and len(plane) not in (3, 6):
        raise ValueError(f"a plane is a point, or a point and a normal: 3 or 6 numbers, got {len(plane)}")
    first, mesh, doubts = _implant(unloaded, name)
    cloud = ImplantPointCloud.from_mesh(mesh, _PITCH_MM, dtype=torch.float64)
    warnings, seconds = list(doubts), []
    for folder in loaded:
        second, second_mesh, doubts = _implant(folder, name)
        warnings += doubts
        seconds.append((second, _nearest(frame_changes(mesh, second_mesh), first, second, cloud.points)))
    fracture: tuple[Tensor, Tensor | None] | None = None
    if plane is not None:
        numbers = torch.tensor(list(plane), dtype=torch.float64)
        fracture = numbers[:3], numbers[3:] if len(plane) == 6 else None
    elif fragment is None:
        fracture = fracture_plane(first, seconds, cloud.points)
    fragments = fragments_of(
        cloud.points,
        first.screws,
        radius_mm=first.follow_radius_mm,
        plane=fracture,
        mesh=None if fragment is None else read_mesh(fragment),
    )
    if not first.screws:
        warnings.append("no screws show what is fixed to which fragment: the ends of the implant are used instead")
    motions = [relative_motion(first, second, cloud, fragments, to_second=change) for second, change in seconds]
    compliance, std = _slopes(motions, loads) if loads else (None, None)
    names = tuple(str(folder) for folder in loaded)
    comparison = Comparison(names, tuple(motions), tuple(loads), compliance, std, tuple(warnings), out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "compare.json", plain(comparison.to_dict()))
    write_text(out / "compare.csv", comparison.table())
    if figures:
        write_figure(out / "compare.png", comparison_figure(motions, [Path(n).name for n in names], loads))
        write_report(out)
    return comparison


def _implant(folder: Path, name: str | None):
    result, implant = implant_of_run(folder, name)
    doubts = [f"{folder} is {result.status}: {why}" for why in result.warnings if result.status != "ok"]
    if implant.deviations is None:
        doubts.append(f"{folder} comes from a version that did not store expected errors: there are no error bars")
    return implant, read_mesh(mesh_of_run(folder, result.implants.index(implant))), doubts


def _nearest(changes: Sequence[Tensor], first: RegisteredImplant, second: RegisteredImplant, points: Tensor) -> Tensor:
    """Frame change with the smallest motion; a symmetric implant has several that map it onto itself."""
    unloaded = first.warp(points.double())
    distances = [float((second.warp(transform_points(c, points.double())) - unloaded).square().mean()) for c in changes]
    return changes[int(np.argmin(distances))]


def _slopes(motions: Sequence[RelativeMotion], loads: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Weighted slopes (6,) of motion over load, through the origin, and their standard deviations."""
    values, std = (torch.stack(parts) for parts in zip(*(motion.numbers for motion in motions), strict=True))
    force = torch.tensor(list(loads), dtype=torch.float64)[:, None]
    weights = 1 / std.square().clamp_min(1e-12)
    scale = (weights * force**2).sum(0)
    return (weights * force * values).sum(0) / scale, scale.rsqrt()

"""Evaluate a run against known points, or against the true shape of the deformed implant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import trimesh
from torch import Tensor

from torchkcreg.evaluation import (
    PointMetrics,
    ShapeEvaluation,
    displacement_map,
    evaluate,
    evaluate_shape,
    point_errors,
)
from torchkcreg.evaluation.shape import ReferenceKind
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import mesh_of_run, read_mesh, read_points, read_reference, read_run, write_figure
from torchkcreg.registration import RegistrationResult
from torchkcreg.visualization import displacement_figure, error_map_figure, histogram_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ENOUGH_FOR_A_MAP = 100  # points


@dataclass(frozen=True, eq=False)
class FileEvaluation:
    """Errors of a run.

    Attributes:
        points: Errors at known points, if points were given.
        shape: Errors against the true shape, if a reference was given.
        pictures: Figure files that were written.
    """

    points: PointMetrics | None
    shape: ShapeEvaluation | None
    pictures: tuple[Path, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Dictionary of the point metrics, with the shape metrics under "shape"."""
        points = {} if self.points is None else self.points.to_dict()
        return points if self.shape is None else {**points, "shape": self.shape.to_dict()}

    def __str__(self) -> str:
        pictures = f"pictures: {', '.join(map(str, self.pictures))}" if self.pictures else None
        return "\n".join(str(part) for part in (self.points, self.shape, pictures) if part is not None)


def evaluate_files(
    run_folder: Path,
    *,
    points: Path | None = None,
    truth: Path | None = None,
    reference: Path | None = None,
    reference_kind: ReferenceKind | None = None,
    implant: Path | None = None,
    figures: Path | None = None,
) -> FileEvaluation:
    """Errors of a finished registration at known points, against the true shape, or both.

    Args:
        run_folder: Folder of the registration.
        points: Points in the undeformed implant's frame (CSV).
        truth: The same points in the world after deformation (CSV).
        reference: True shape of the deformed implant, see `torchkcreg.io.read_reference`.
        reference_kind: "volume" or "surface": whether the reference's points fill its volume or lie on its surface;
            detected if None.
        implant: Mesh of the undeformed implant; the run's mesh if None.
        figures: Folder for figures: displacement map, error maps and histograms.

    Raises:
        ValueError: If there is nothing to compare with, or files do not fit.
        FileNotFoundError: If a file is missing.
    """
    if (points is None) != (truth is None):
        missing, given = ("truth", "points") if truth is None else ("points", "truth")
        raise ValueError(f"{given} need {missing} to compare with: give both")
    if points is None and reference is None:
        raise ValueError("nothing to compare with: give points and truth, or a reference")
    if reference is None and reference_kind is not None:
        raise ValueError("a reference kind needs a reference")
    result = read_run(run_folder)
    metrics = pairs = shape = mesh = None
    if points is not None and truth is not None:
        pairs = read_points(points), read_points(truth)
        metrics = evaluate(result, *pairs)
    if reference is not None or figures is not None:
        mesh = read_mesh(implant or mesh_of_run(run_folder))
    if reference is not None and mesh is not None:
        true = read_reference(reference)
        pitch = result.config.pitch_mm
        nodes = result.warp(ImplantPointCloud.from_mesh(mesh, pitch, dtype=torch.float64).points)
        surface = result.deformed(mesh)
        shape = evaluate_shape(surface, nodes, true, pitch_mm=pitch, reference_kind=reference_kind)
    pictures = _draw(figures, result, mesh, shape, pairs) if figures is not None and mesh is not None else ()
    return FileEvaluation(metrics, shape, tuple(pictures))


def _draw(
    folder: Path,
    result: RegistrationResult,
    mesh: trimesh.Trimesh,
    shape: ShapeEvaluation | None,
    pairs: tuple[Tensor, Tensor] | None,
) -> list[Path]:
    drawn = {"displacement.png": _displacement(result, mesh)}
    if shape is not None:
        drawn |= _shape_figures(shape)
    if pairs is not None and len(pairs[0]) >= _ENOUGH_FOR_A_MAP:
        errors = point_errors(result.warp(pairs[0]), pairs[1])
        drawn["point_errors.png"] = error_map_figure(pairs[1], errors, title="error at the known points")
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        write_figure(folder / name, figure)
    return [folder / name for name in drawn]


def _displacement(result: RegistrationResult, mesh: trimesh.Trimesh) -> Figure:
    cloud = ImplantPointCloud.from_mesh(mesh, 2 * result.config.pitch_mm, dtype=torch.float64)
    bent = displacement_map(cloud.points, result.warp(cloud.points), weights=cloud.volumes)
    return displacement_figure(
        bent.undeformed,
        bent.vectors,
        title="bending of the implant, its distal end at rest",
        label="displacement against the distal end (mm)",
    )


def _shape_figures(shape: ShapeEvaluation) -> dict[str, Figure]:
    name = "nodes" if shape.surface_after is None else "surface"
    label = f"distance to the reference's {'surface' if name == 'surface' else 'nearest node'}"
    if shape.reference == "surface":
        label = "distance of the scanned points from the registered surface"
    title, histogram_title = f"{label}, after rigid alignment", f"{label}, before and after rigid alignment"
    before, after = (getattr(shape, f"{name}_{when}") for when in ("before", "after"))
    distances, widths = {"after": shape.errors}, {"after": after.fwhm_mm}
    if shape.errors_before is not None:
        distances = {"before": shape.errors_before, **distances}
        widths["before"] = before.fwhm_mm
    floor = shape.node_floor[0] if shape.node_floor is not None and name == "nodes" else None
    return {
        "error_map.png": error_map_figure(shape.points, shape.errors, title=title),
        "histogram.png": histogram_figure(distances, fwhm_mm=widths, floor_mm=floor, title=histogram_title),
    }

"""What an implant's true shape is read from: a closed surface, or a point cloud."""

from __future__ import annotations

import os

import torch
import trimesh
from torch import Tensor

from torchkcreg.io.files import existing_file
from torchkcreg.io.meshes import MESH_SUFFIXES, read_mesh
from torchkcreg.io.points import read_points

CLOUD_SUFFIXES = (".csv", ".txt", ".xyz")


def read_reference(path: str | os.PathLike[str]) -> trimesh.Trimesh | Tensor:
    """A reference shape in mm: a closed surface, or points (N, 3) float64.

    CSV, TXT and XYZ hold points, x, y, z a line. A PLY holds points if it has no faces, such as the
    `implant_deformed.ply` of a run; the other formats of `read_mesh` are surfaces.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is of no known format, cannot be read, holds no points, or a point that is not finite; a surface
            is open.
    """
    path = existing_file(path, "reference")
    suffix = path.suffix.lower()
    if suffix in CLOUD_SUFFIXES:
        return read_points(path)
    if suffix not in MESH_SUFFIXES:
        raise ValueError(f"reference file {path} must be one of {', '.join((*MESH_SUFFIXES, *CLOUD_SUFFIXES))}")
    if suffix == ".ply" and (points := _ply_points(path)) is not None:
        return points
    return read_mesh(path)


def _ply_points(path: os.PathLike[str]) -> Tensor | None:
    """The points of a PLY without faces; None where it has some."""
    try:
        content = trimesh.load(str(path), process=False)
    except Exception as error:  # the parser fails in its own ways
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"reference file {path} cannot be read: {reason}") from error
    vertices = getattr(content, "vertices", ())
    if len(getattr(content, "faces", ())):
        return None
    if len(vertices) == 0:
        raise ValueError(f"reference file {path} holds neither faces nor points")
    points = torch.tensor(vertices, dtype=torch.float64)
    if not bool(points.isfinite().all()):
        row = int((~points.isfinite().all(-1)).nonzero()[0])
        raise ValueError(f"reference file {path} must hold finite points, but number {row} is not")
    return points

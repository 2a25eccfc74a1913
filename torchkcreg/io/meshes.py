"""Implant surfaces from CAD files, and point clouds for viewers."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.implant import closed_mesh, scanned_surface
from torchkcreg.io.files import atomic_path, existing_file
from torchkcreg.io.step import STEP_SUFFIXES, load_step
from torchkcreg.io.stl import load_stl
from torchkcreg.io.volumes import VOLUME_SUFFIXES, read_volume

WRITTEN_SUFFIXES = (".stl", ".obj", ".ply", ".off")
MESH_SUFFIXES = (*WRITTEN_SUFFIXES, ".3mf", *STEP_SUFFIXES)
_METRES_MM, _SMALLEST_MM, _LARGEST_MM = 1.0, 20.0, 1000.0


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """The closed surface of an STL, OBJ, PLY, OFF, 3MF or STEP file, in mm, oriented outwards.

    Of a volume (MHA, NRRD, NIfTI), a bench scan of the implant, it is the surface where values are half of the metal's,
    in the volume's world; see `scanned_surface`.
    3MF and STEP say their unit and are converted (extras io and cad); the others are taken to be in mm.
    Equal vertices are merged, faces that this collapses dropped; several bodies in one file are one surface. A largest
    extent under 1, under 20 or over 1000 mm gives a warning: the file is probably in metres, in cm or inches, or not in
    mm.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read as a mesh, is empty, or is open; the message counts the open edges.
    """
    path = existing_file(path, "mesh")
    if path.name.lower().endswith(VOLUME_SUFFIXES):
        return _surface_of_volume(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ValueError(f"mesh file {path} must be one of {', '.join((*MESH_SUFFIXES, *VOLUME_SUFFIXES))}")
    try:
        mesh = _loaded(path, suffix)
    except Exception as error:  # each of trimesh's parsers fails in its own way
        hint = " (3MF needs the package lxml)" if suffix == ".3mf" and _lacks("lxml") else ""
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"mesh file {path} cannot be read: {reason}{hint}") from error
    if len(mesh.faces) == 0:
        raise ValueError(f"mesh file {path} holds no triangles")
    try:
        closed = closed_mesh(mesh)
    except ValueError as error:
        raise ValueError(f"mesh file {path}: {error}") from error
    if suffix == ".3mf" and mesh.units:  # the one format that says its unit
        closed.apply_scale(trimesh.units.unit_conversion(mesh.units, "millimeters"))
    _warn_about_size(path, closed)
    return closed


def _loaded(path: Path, suffix: str) -> trimesh.Trimesh:
    """The mesh of a file, as it is."""
    if suffix == ".stl":
        return load_stl(path.read_bytes())
    if suffix in STEP_SUFFIXES:
        return load_step(path)
    mesh = trimesh.load(str(path), force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh):
        raise ValueError("it holds no triangles")
    return mesh


def _surface_of_volume(path: Path) -> trimesh.Trimesh:
    volume, grid = read_volume(path)
    try:
        surface = closed_mesh(scanned_surface(volume, grid))
    except ValueError as error:
        raise ValueError(f"volume file {path}: {error}") from error
    _warn_about_size(path, surface)
    return surface


def write_mesh(path: str | os.PathLike[str], mesh: trimesh.Trimesh) -> None:
    """Nothing; writes a surface, its format chosen by the suffix (.stl, .obj, .ply, .off)."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise ValueError(f"meshes are written as {', '.join(WRITTEN_SUFFIXES)}, got {path}")
    with atomic_path(path) as temporary:
        mesh.export(str(temporary), file_type=suffix[1:])


def write_point_cloud_ply(
    path: str | os.PathLike[str], points: Tensor, displacement: Tensor | None = None, std: Tensor | None = None
) -> None:
    """Nothing; writes points as a binary PLY that ParaView, MeshLab, CloudCompare and 3D Slicer open.

    Args:
        path: the file.
        points: (N, 3) in mm.
        displacement: (N, 3) in mm, becomes the vertex fields `dx`, `dy`, `dz` and its length `displacement`.
        std: expected error of each (N,), mm, becomes `std`.

    Raises:
        ValueError: shapes don't fit, or there is no point.
    """
    if points.ndim != 2 or points.shape[-1] != 3 or len(points) == 0:
        raise ValueError(f"points must have shape (N, 3), N > 0, got {tuple(points.shape)}")
    columns = {name: points[:, i] for i, name in enumerate("xyz")}
    if displacement is not None:
        if displacement.shape != points.shape:
            raise ValueError(f"displacement must have shape {tuple(points.shape)}, got {tuple(displacement.shape)}")
        columns |= {f"d{name}": displacement[:, i] for i, name in enumerate("xyz")}
        columns["displacement"] = torch.linalg.vector_norm(displacement, dim=-1)
    if std is not None:
        if std.shape != points.shape[:1]:
            raise ValueError(f"std must have shape ({len(points)},), got {tuple(std.shape)}")
        columns["std"] = std
    table = np.empty(len(points), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column.detach().cpu().numpy()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment lengths in mm",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in columns),
        "end_header",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + b"\n" + table.tobytes())


def _warn_about_size(path: Path, mesh: trimesh.Trimesh) -> None:
    extents = " x ".join(f"{e:.4g}" for e in mesh.extents)
    if mesh.extents.max() < _METRES_MM:
        warnings.warn(f"mesh file {path} is {extents} mm: it is probably in metres", stacklevel=3)
    elif mesh.extents.max() < _SMALLEST_MM:
        warnings.warn(f"mesh file {path} is {extents} mm, small for an implant: is it in cm or inches?", stacklevel=3)
    elif mesh.extents.max() > _LARGEST_MM:
        warnings.warn(f"mesh file {path} is {extents} mm: it is probably not in mm", stacklevel=3)


def _lacks(package: str) -> bool:
    try:
        __import__(package)
    except ImportError:
        return True
    return False

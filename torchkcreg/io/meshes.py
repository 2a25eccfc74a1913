"""Implant surfaces (STL, OBJ, PLY, OFF, 3MF, STEP, scanned volumes), and writing of PLY point clouds."""

from __future__ import annotations

import importlib.util
import os
import re
import struct
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import trimesh

from torchkcreg.implant import closed_mesh, scanned_surface
from torchkcreg.plain import first_line

from .files import atomic_path, existing_file
from .volumes import VOLUME_SUFFIXES, read_volume

STEP_SUFFIXES = (".step", ".stp")
DEFLECTION_MM, DEFLECTION_RAD = 0.005, 0.05  # largest deviation of the triangles from the true surface
SECONDS = 300  # time limit per file
_CONVERT = "import sys, cascadio; _, a, b, mm, rad = sys.argv; cascadio.step_to_glb(a, b, float(mm), float(rad))"
_HEADER, _TRIANGLE = 84, 50  # bytes
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_FLAGS = re.MULTILINE | re.IGNORECASE
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t]*$", _FLAGS)
_WORDS = [re.compile(rb"^[ \t]*" + word + rb"\b", _FLAGS) for word in (b"facet", b"endfacet", b"solid", b"endsolid")]
WRITTEN_SUFFIXES = (".stl", ".obj", ".ply", ".off")
MESH_SUFFIXES = (*WRITTEN_SUFFIXES, ".3mf", *STEP_SUFFIXES)
_METRES_MM, _SMALLEST_MM, _LARGEST_MM = 1.0, 20.0, 1000.0


def load_step(path: Path) -> trimesh.Trimesh:
    """The surface of all bodies of a STEP file, accurate to 5 micrometres.

    The unit of the file is converted to mm.

    Raises:
        ValueError: The file is damaged or holds no body, or cascadio is not installed.
    """
    if importlib.util.find_spec("cascadio") is None:
        raise ValueError("STEP files need cascadio: pip install 'torchkcreg[cad]'")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "surface.glb"
        command = [sys.executable, "-c", _CONVERT, str(path), str(target), str(DEFLECTION_MM), str(DEFLECTION_RAD)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired:
            raise ValueError(f"its conversion to a surface takes longer than {SECONDS} s") from None
        if done.returncode != 0 or not target.is_file() or target.stat().st_size == 0:
            raise ValueError("it is no STEP file with a body")
        try:
            scene = trimesh.load(str(target), force="mesh", process=False)
        except Exception as error:  # raised for a scene without a surface
            raise ValueError("it holds no surface") from error
    if not isinstance(scene, trimesh.Trimesh) or len(scene.faces) == 0:
        raise ValueError("it holds no surface")
    scene.apply_scale(1000.0)  # GLB is in metres
    return scene


def load_stl(content: bytes) -> trimesh.Trimesh:
    """The triangles of a binary or ASCII STL file; vertices are not merged.

    The name in the first line is ignored and may contain any bytes.

    Raises:
        ValueError: The file is truncated, longer than its triangle count implies, or no STL.
    """
    if is_text(content):
        return _load_text(content)
    if len(content) < _HEADER:
        raise ValueError(f"it is no STL: {len(content)} bytes, where a header alone has {_HEADER}")
    (count,) = struct.unpack_from("<I", content, 80)
    expected = _HEADER + _TRIANGLE * count
    if len(content) != expected:
        what = (
            "it is cut off or its count is wrong" if len(content) < expected else "its count is wrong or bytes follow"
        )
        raise ValueError(f"{what}: {count} triangles take {expected} bytes, it has {len(content)}")
    return _soup(np.frombuffer(content, _RECORD, count, _HEADER)["corners"])


def is_text(content: bytes) -> bool:
    """True if an STL is ASCII. A binary STL may also begin with "solid", but its length fits its triangle count."""
    if not content[:512].lstrip().lower().startswith(b"solid"):
        return False
    if len(content) >= _HEADER and len(content) == _HEADER + _TRIANGLE * struct.unpack_from("<I", content, 80)[0]:
        return False
    return b"\0" not in content


def _load_text(content: bytes) -> trimesh.Trimesh:
    lines = content.replace(b"\r", b"\n")
    facets, ends, solids, closed = (len(w.findall(lines)) for w in _WORDS)
    corners = _VERTEX.findall(lines)
    if facets != ends or solids != closed or len(corners) != 3 * facets:
        raise ValueError(
            f"it is cut off or damaged: {facets} facets begin and {ends} end, with {len(corners)} vertices; "
            f"{solids} solids begin and {closed} end"
        )
    try:
        return _soup(np.array(corners).astype(np.float64))
    except ValueError as error:
        raise ValueError(f"it has a vertex that is no number: {error}") from None


def _soup(corners: np.ndarray) -> trimesh.Trimesh:
    vertices = corners.astype(np.float64).reshape(-1, 3)
    return trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False)


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Read a closed surface from an STL, OBJ, PLY, OFF, 3MF or STEP file, in mm, oriented outwards.

    From a volume (MHA, NRRD, NIfTI), such as a bench scan of the implant, the isosurface at half the metal's value is
    extracted, in the volume's world coordinates; see `scanned_surface`.

    3MF and STEP files state their unit and are converted (extras io and cad). The others are assumed to be in mm.
    Duplicate vertices are merged, and faces that thereby collapse are dropped. Several bodies in one file become one
    surface. A warning is given if the largest extent is below 1 mm (probably metres), below 20 mm (cm or inches) or
    above 1000 mm (not mm).

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read as a mesh, is empty, or the surface is open; the message counts the open
            edges.
    """
    path = existing_file(path, "mesh")
    if path.name.lower().endswith(VOLUME_SUFFIXES):
        return _surface_of_volume(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ValueError(f"mesh file {path} must be one of {', '.join((*MESH_SUFFIXES, *VOLUME_SUFFIXES))}")
    try:
        mesh = _loaded(path, suffix)
    except Exception as error:  # trimesh's parsers raise various types
        hint = " (3MF needs the package lxml)" if suffix == ".3mf" and _lacks("lxml") else ""
        reason = first_line(error)
        raise ValueError(f"mesh file {path} cannot be read: {reason}{hint}") from error
    if len(mesh.faces) == 0:
        raise ValueError(f"mesh file {path} holds no triangles")
    try:
        closed = closed_mesh(mesh)
    except ValueError as error:
        raise ValueError(f"mesh file {path}: {error}") from error
    if suffix == ".3mf" and mesh.units:  # the only other format that states its unit
        closed.apply_scale(trimesh.units.unit_conversion(mesh.units, "millimeters"))
    _warn_about_size(path, closed)
    return closed


def _loaded(path: Path, suffix: str) -> trimesh.Trimesh:
    """The mesh of a file, unprocessed."""
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
    """Write a surface in the format of the suffix (.stl, .obj, .ply, .off)."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise ValueError(f"meshes are written as {', '.join(WRITTEN_SUFFIXES)}, got {path}")
    with atomic_path(path) as temporary:
        mesh.export(str(temporary), file_type=suffix[1:])


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

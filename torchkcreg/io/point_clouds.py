"""Point clouds and reference shapes: reference points or surfaces, VTK files (VTU, VTP), and this library's PLY."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.plain import first_line

from .files import atomic_path, existing_file
from .meshes import MESH_SUFFIXES, read_mesh
from .tables import read_points

CLOUD_SUFFIXES = (".csv", ".txt", ".xyz")
_TRIANGLE = 5  # VTK's cell type number
LONGEST_HEADER = 4096  # bytes


def read_reference(path: str | os.PathLike[str]) -> trimesh.Trimesh | Tensor:
    """Read a reference shape in mm: a closed surface, or points (N, 3) float64.

    CSV, TXT and XYZ files hold points, one x, y, z per line. A PLY without faces, such as the `implant_deformed.ply` of
    a run, also holds points. The other formats of `read_mesh` hold surfaces.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The format is unknown, the file cannot be read, it holds no points or a non-finite point, or the
            surface is open.
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
    """The points of a PLY without faces; None if it has faces."""
    try:
        content = trimesh.load(str(path), process=False)
    except Exception as error:  # the parser raises various types
        reason = first_line(error)
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


def write_surface_vtu(path: str | os.PathLike[str], mesh: trimesh.Trimesh, values: Mapping[str, Tensor]) -> None:
    """Write a triangle mesh with values at its vertices as VTK XML (.vtu).

    Args:
        path: The file, ending in .vtu.
        mesh: Mesh with V vertices, mm.
        values: Scalars (V,) or vectors (V, 3), by name.

    Raises:
        ValueError: The length of an array is not the number of vertices.
    """
    count = len(mesh.vertices)
    for name, value in values.items():
        if len(value) != count:
            raise ValueError(f"{name} must have a value for each of {count} vertices, got {len(value)}")
    root = ElementTree.Element("VTKFile", type="UnstructuredGrid", version="1.0", byte_order="LittleEndian")
    grid = ElementTree.SubElement(root, "UnstructuredGrid")
    piece = ElementTree.SubElement(grid, "Piece", NumberOfPoints=str(count), NumberOfCells=str(len(mesh.faces)))
    data = ElementTree.SubElement(piece, "PointData")
    for name, value in values.items():
        _array(data, name, value.detach().cpu().double().numpy())
    _array(ElementTree.SubElement(piece, "Points"), "Points", np.asarray(mesh.vertices))
    cells = ElementTree.SubElement(piece, "Cells")
    _array(cells, "connectivity", np.asarray(mesh.faces).ravel())
    _array(cells, "offsets", 3 * np.arange(1, len(mesh.faces) + 1))
    _array(cells, "types", np.full(len(mesh.faces), _TRIANGLE))
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, xml_declaration=True, encoding="utf-8")


def write_points_vtp(path: str | os.PathLike[str], points: Tensor, values: Mapping[str, Tensor]) -> None:
    """Write points with values as VTK XML (.vtp), in single precision.

    Args:
        path: The file, ending in .vtp.
        points: (N, 3), mm.
        values: Scalars (N,) or vectors (N, 3), by name.

    Raises:
        ValueError: The length of an array is not the number of points.
    """
    count = len(points)
    for name, value in values.items():
        if len(value) != count:
            raise ValueError(f"{name} must have a value for each of {count} points, got {len(value)}")
    sizes = {"type": "PolyData", "version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64"}
    root = ElementTree.Element("VTKFile", sizes)
    piece = ElementTree.SubElement(
        ElementTree.SubElement(root, "PolyData"), "Piece", NumberOfPoints=str(count), NumberOfVerts=str(count)
    )
    data = ElementTree.SubElement(piece, "PointData")
    for name, value in values.items():
        _packed(data, name, value.detach().cpu().numpy().astype("<f4"))
    _packed(ElementTree.SubElement(piece, "Points"), "Points", points.detach().cpu().numpy().astype("<f4"))
    cells = ElementTree.SubElement(piece, "Verts")
    _packed(cells, "connectivity", np.arange(count, dtype="<i8"))
    _packed(cells, "offsets", np.arange(1, count + 1, dtype="<i8"))
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, xml_declaration=True, encoding="utf-8")


def _packed(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    """Append a binary DataArray: base64 of the number of bytes (uint64), followed by the raw values."""
    element = _array_element(parent, name, values, "Int64" if values.dtype.kind == "i" else "Float32", "binary")
    size = np.array([values.nbytes], dtype="<u8")
    element.text = base64.b64encode(size.tobytes() + np.ascontiguousarray(values).tobytes()).decode()


def _array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    is_integer = values.dtype.kind in "iu"
    element = _array_element(parent, name, values, "Int64" if is_integer else "Float64", "ascii")
    element.text = (
        " ".join(str(x) for x in values.ravel()) if is_integer else " ".join(f"{x:.7g}" for x in values.ravel())
    )


def _array_element(
    parent: ElementTree.Element, name: str, values: np.ndarray, kind: str, form: str
) -> ElementTree.Element:
    attributes = {"type": kind, "Name": name, "format": form}
    if values.ndim == 2:
        attributes["NumberOfComponents"] = str(values.shape[1])
    return ElementTree.SubElement(parent, "DataArray", attributes)


def write_point_cloud_ply(
    path: str | os.PathLike[str], points: Tensor, displacement: Tensor | None = None, std: Tensor | None = None
) -> None:
    """Write points as a binary PLY for ParaView, MeshLab, CloudCompare and 3D Slicer.

    Args:
        path: The file.
        points: (N, 3) in mm.
        displacement: (N, 3) in mm, written as the vertex fields `dx`, `dy`, `dz`, and its length as `displacement`.
        std: Expected error of each point (N,), mm, written as `std`.

    Raises:
        ValueError: The shapes do not fit, or there are no points.
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


def read_point_cloud_ply(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read a PLY of `write_point_cloud_ply`: columns (N,) by name.

    The names are x, y, z, and, if present, dx, dy, dz, displacement, std.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is another kind of PLY, or its length does not fit its header.
    """
    content = existing_file(path, "point cloud").read_bytes()
    end = content.find(b"end_header\n", 0, LONGEST_HEADER)
    lines = content[:end].decode("ascii", errors="replace").splitlines()
    if end < 0 or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ValueError(f"point cloud file {path} is no binary PLY")
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    body = content[end + len(b"end_header\n") :]
    if len(counts) != 1 or not counts[0].isdigit() or names[:3] != ["x", "y", "z"]:
        raise ValueError(f"point cloud file {path} has no vertices of floats x, y, z")
    if len(body) != int(counts[0]) * 4 * len(names):
        raise ValueError(f"point cloud file {path} does not hold the {counts[0]} points that its header says")
    table = np.frombuffer(body, dtype="<f4").reshape(-1, len(names))
    return {name: torch.from_numpy(table[:, i].copy()) for i, name in enumerate(names)}

"""Surfaces (VTU) and points (VTP) with values, which ParaView and 3D Slicer open."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
import trimesh
from torch import Tensor

from torchkcreg.io.files import atomic_path

_TRIANGLE = 5  # VTK's number of the cell type


def write_surface_vtu(path: str | os.PathLike[str], mesh: trimesh.Trimesh, values: Mapping[str, Tensor]) -> None:
    """Nothing; writes a triangle mesh with values at its vertices as VTK XML.

    Args:
        path: The file, ending in .vtu.
        mesh: V vertices, mm.
        values: Name to values (V,) or vectors (V, 3).

    Raises:
        ValueError: A value does not belong to the vertices.
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
    """Nothing; writes points with values as VTK XML, in single precision.

    Args:
        path: The file, ending in .vtp.
        points: (N, 3), mm.
        values: Name to values (N,) or vectors (N, 3).

    Raises:
        ValueError: A value does not belong to the points.
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
    """Numbers as they lie in memory, after their number of bytes, in base64."""
    element = _array_element(parent, name, values, "Int64" if values.dtype.kind == "i" else "Float32", "binary")
    size = np.array([values.nbytes], dtype="<u8")
    element.text = base64.b64encode(size.tobytes() + np.ascontiguousarray(values).tobytes()).decode()


def _array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    whole = values.dtype.kind in "iu"
    element = _array_element(parent, name, values, "Int64" if whole else "Float64", "ascii")
    element.text = " ".join(str(x) for x in values.ravel()) if whole else " ".join(f"{x:.7g}" for x in values.ravel())


def _array_element(
    parent: ElementTree.Element, name: str, values: np.ndarray, kind: str, form: str
) -> ElementTree.Element:
    about = {"type": kind, "Name": name, "format": form}
    if values.ndim == 2:
        about["NumberOfComponents"] = str(values.shape[1])
    return ElementTree.SubElement(parent, "DataArray", about)

"""Surfaces with values at their vertices as VTU, which ParaView and 3D Slicer open."""

from __future__ import annotations

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


def _array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    whole = values.dtype.kind in "iu"
    kind = {"type": "Int64" if whole else "Float64", "Name": name, "format": "ascii"}
    if values.ndim == 2:
        kind["NumberOfComponents"] = str(values.shape[1])
    element = ElementTree.SubElement(parent, "DataArray", kind)
    element.text = " ".join(str(x) for x in values.ravel()) if whole else " ".join(f"{x:.7g}" for x in values.ravel())

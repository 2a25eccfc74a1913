"""Hardware: meshes of straight and flared locking plates, their holes and screws, and the mapping of meshes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.implant import Screw

from .outline import plate_outline


def locking_plate(
    *,
    length: float = 188.0,
    width: float = 13.5,
    thickness: float = 4.6,
    num_holes: int = 10,
    hole_radius: float = 2.4,
    end_margin: float = 4.0,
    max_edge: float = 2.5,
    hole_offset: float = 0.0,
) -> trimesh.Trimesh:
    """Watertight mesh of a straight plate with through holes in one row and rounded ends, centred on the origin.

    Long axis z, width x, thickness y; the bone is at negative y. Grid lines `max_edge` apart make the mesh bend
    smoothly.

    Args:
        length: Length along z, mm.
        width: Width along x, mm.
        thickness: Thickness along y, mm.
        num_holes: Number of evenly spaced holes; see `hole_positions`.
        hole_radius: Radius of a hole, mm.
        end_margin: Length of each rounded end, mm; the rest is divided evenly among the holes.
        max_edge: Spacing of the surface's grid lines, mm; triangles' long sides are up to 1.6 times as long.
        hole_offset: A combination hole is the union of two round ones, this far before and behind its middle, mm.

    Raises:
        ValueError: If a hole does not fit into its part of the plate, or a size is not positive.

    >>> plate = locking_plate()
    >>> plate.is_watertight, plate.extents.round(2).tolist()
    (True, [13.5, 4.6, 188.0])
    """
    for name, value in (("length", length), ("width", width), ("thickness", thickness), ("max_edge", max_edge)):
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")
    points, triangles = plate_outline(length, width, num_holes, hole_radius, end_margin, max_edge, hole_offset)
    return _extruded(points, triangles, thickness, max(1, math.ceil(thickness / max_edge)))


def hole_positions(*, length: float = 188.0, num_holes: int = 10, end_margin: float = 4.0) -> list[float]:
    """Centres of a plate's holes along z in mm, from the lowest up.

    >>> hole_positions()[:2]
    [-81.0, -63.0]
    """
    pitch = (length - 2 * end_margin) / num_holes
    return [(hole - (num_holes - 1) / 2) * pitch for hole in range(num_holes)]


def locking_screws(
    positions: Sequence[float],
    *,
    head_y: float = 2.3,
    tip_y: float = -34.0,
    radius: float = 2.0,
    material: str = "steel",
) -> list[Screw]:
    """Screws through a plate at heights z in mm, in its frame.

    >>> locking_screws([-63.0])[0].length
    36.3
    """
    return [
        Screw((0.0, head_y, float(z)), (0.0, tip_y, float(z)), radius, material, f"screw{number}")
        for number, z in enumerate(positions)
    ]


def flared(plate: trimesh.Trimesh, length: float, flare: float) -> trimesh.Trimesh:
    """Widen the upper end of a straight plate in place, to `flare` times its shaft's width, and return it."""
    share = ((plate.vertices[:, 2] / length - 0.05) / 0.35).clip(0, 1)
    plate.vertices[:, 0] *= 1 + (flare - 1) * share**2 * (3 - 2 * share)
    return plate


def mapped(mesh: trimesh.Trimesh, mapping: Callable[[Tensor], Tensor]) -> trimesh.Trimesh:
    """Copy of the mesh with all vertices mapped in float64."""
    vertices = mapping(torch.tensor(np.asarray(mesh.vertices), dtype=torch.float64, device="cpu"))
    return trimesh.Trimesh(vertices.numpy(), mesh.faces, process=False)


def _extruded(points: np.ndarray, triangles: np.ndarray, thickness: float, layers: int) -> trimesh.Trimesh:
    """A flat triangulation in (x, z) extruded along y, its side walls in `layers` layers."""
    count = len(points)
    heights = np.linspace(thickness / 2, -thickness / 2, layers + 1)
    vertices = np.concatenate([np.insert(points, 1, height, axis=1) for height in heights])
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    keys, reverse = directed @ [count, 1], directed @ [1, count]
    rim = directed[~np.isin(keys, reverse)]  # edges without a neighbour: the outline and the holes
    faces = [triangles, triangles[:, ::-1] + layers * count]
    for layer in range(layers):
        start, end = (rim + layer * count).T
        faces.append(np.stack([end, start, start + count], axis=1))
        faces.append(np.stack([end, start + count, end + count], axis=1))
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0:
        mesh.invert()
    return mesh

"""Finds the round screw holes of an implant in its mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_STEEPEST_TURN = np.deg2rad(50.0)  # between neighbouring faces of a hole's wall
_FLAT = np.deg2rad(3.0)  # in a bent implant the triangles of one wall facet are not exactly coplanar
_ALONG_AXIS = 0.35  # bound on the axial component of a wall's normals; those of countersinks have more
_RIM = 1.6  # in radii: distance from the axis within which a countersink ends
_OPENING = np.deg2rad(170.0)  # largest gap of a wall around its axis: holes of a combination hole are open to a side


@dataclass(frozen=True, eq=False)
class Hole:
    """A round hole through an implant or into it.

    Attributes:
        center: Middle of its axis, (3,), in the mesh's frame, mm.
        axis: Unit vector (3,) along its axis; the sign has no meaning.
        radius: Radius where the hole is narrowest, mm.
        depth: Length along its axis between the implant's surfaces, countersinks included, mm.
    """

    center: np.ndarray
    axis: np.ndarray
    radius: float
    depth: float


def find_holes(mesh: trimesh.Trimesh, *, smallest_mm: float = 0.75, largest_mm: float = 5.0) -> list[Hole]:
    """Round holes with a radius between two bounds, mm, ordered by their position along the implant.

    The wall of a hole is a patch of faces that meet at concave edges. The normals of a round wall are perpendicular to
    the axis, point in all directions around it, and meet on it. Countersinks and threads only add faces whose normals
    are inclined to the axis. A combination hole counts as its two round holes.

    Example:
        >>> plate = trimesh.creation.annulus(r_min=2.0, r_max=8.0, height=4.0)
        >>> [(round(h.radius, 1), round(h.depth, 1)) for h in find_holes(plate)]
        [(2.0, 4.0)]
    """
    merged = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    angles = merged.face_adjacency_angles
    inwards = ~merged.face_adjacency_convex & (angles > 1e-6) & (angles < _STEEPEST_TURN)
    flat = angles < _FLAT
    curved = np.zeros(len(merged.faces), bool)
    curved[merged.face_adjacency[inwards]] = True
    # joins the triangles of one flat facet of a wall
    within = flat & curved[merged.face_adjacency].any(axis=1)
    faces = _Faces(merged.triangles, merged.face_normals, merged.area_faces)
    holes = [
        _hole_of(faces.of(patch)) for patch in _patches(merged.face_adjacency[inwards | within], len(merged.faces))
    ]
    joined_holes: list[Hole] = []
    for hole in holes:
        if hole is not None and smallest_mm <= hole.radius <= largest_mm:
            joined_holes = _joined(joined_holes, hole)
    spread = np.linalg.svd(merged.vertices - merged.vertices.mean(axis=0), full_matrices=False)[2][0]
    return sorted((_to_the_surfaces(h, merged.vertices) for h in joined_holes), key=lambda h: float(h.center @ spread))


def _to_the_surfaces(hole: Hole, vertices: np.ndarray) -> Hole:
    """The hole extended from surface to surface: with a countersink or a step it begins above its wall."""
    spokes = vertices - hole.center
    along = spokes @ hole.axis
    aside = np.linalg.norm(spokes - np.outer(along, hole.axis), axis=1)
    about = (aside < _RIM * hole.radius) & (np.abs(along) < hole.depth / 2 + hole.radius)
    low, high = along[about].min(), along[about].max()
    return Hole(hole.center + (low + high) / 2 * hole.axis, hole.axis, hole.radius, float(high - low))


class _Faces(NamedTuple):
    """Corners (n, 3, 3), normals (n, 3) and areas (n,) of faces."""

    triangles: np.ndarray
    normals: np.ndarray
    areas: np.ndarray

    def of(self, index: np.ndarray) -> _Faces:
        """The faces with the given indices."""
        return _Faces(self.triangles[index], self.normals[index], self.areas[index])


def _patches(pairs: np.ndarray, count: int) -> list[np.ndarray]:
    """Face indices of each connected patch, from pairs (m, 2) of neighbours among `count` faces."""
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels = connected_components(links, directed=False)[1]
    linked = np.unique(pairs)
    order = linked[np.argsort(labels[linked], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []


def _hole_of(patch: _Faces) -> Hole | None:
    """The hole whose wall is a patch of faces; None if the patch is not the wall of a round hole."""
    normals, areas = patch.normals, patch.areas
    axis = np.linalg.eigh((normals * areas[:, None]).T @ normals)[1][:, 0]
    wall = np.abs(normals @ axis) < _ALONG_AXIS
    if wall.sum() < 5:
        return None
    triangles, normals, areas = patch.of(wall)
    centers, corners = triangles.mean(1), triangles.reshape(-1, 3)
    across = normals - np.outer(normals @ axis, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # least squares for the point p with equal distances to the planes of the wall's faces: p.n - c.n = -radius
    system = np.column_stack([across, np.ones(len(across))]) * np.sqrt(areas)[:, None]
    system = np.vstack([system, np.append(axis, 0.0) * np.sqrt(areas.sum())])
    middle = np.median(corners @ axis)
    heights = np.einsum("ij,ij->i", centers, across)
    target = np.append(heights * np.sqrt(areas), middle * np.sqrt(areas.sum()))
    solution = np.linalg.lstsq(system, target, rcond=None)[0]
    along = corners @ axis
    center = solution[:3] + ((along.min() + along.max()) / 2 - solution[:3] @ axis) * axis
    spokes = corners - center
    distances = np.linalg.norm(spokes - np.outer(spokes @ axis, axis), axis=1)
    if -solution[3] < 0.3 * distances.min() or not _faces_all_ways(across, axis):
        return None
    return Hole(center, axis, float(distances.min()), float(along.max() - along.min()))


def _joined(holes: list[Hole], new: Hole) -> list[Hole]:
    """Holes with a new one added; rings of the same wall, separated by a thread or a seam, are joined."""
    for index, old in enumerate(holes):
        way = new.center - old.center
        along = float(way @ old.axis)
        aside = np.linalg.norm(way - along * old.axis)
        if aside < 0.3 * old.radius and abs(along) < (old.depth + new.depth) / 2 + old.radius:
            low, high = min(-old.depth / 2, along - new.depth / 2), max(old.depth / 2, along + new.depth / 2)
            center = old.center + (low + high) / 2 * old.axis
            joined = Hole(center, old.axis, min(old.radius, new.radius), high - low)
            return _joined([*holes[:index], *holes[index + 1 :]], joined)
    return [*holes, new]


def _faces_all_ways(across: np.ndarray, axis: np.ndarray) -> bool:
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    angles = np.sort(np.arctan2(across @ np.cross(axis, first), across @ first))
    return bool(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() < _OPENING)

"""Meshes checked and made ready for volume integrals: closed, consistently wound, outside counter-clockwise."""

from __future__ import annotations

import numpy as np
import trimesh


def closed_triangles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Triangles (m, 3, 3), float64, of a closed mesh, wound counter-clockwise seen from outside.

    Vertices at the same place are merged first, since STL files repeat them. Inverted meshes are turned inside out, and
    mixed winding is repaired; the mesh passed in stays as it is.

    Raises:
        ValueError: the mesh has open edges (their number is given), no volume, or a surface that has no two sides.
    """
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"mesh must be a trimesh.Trimesh with faces, got {mesh!r}")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("mesh must have finite vertices")
    merged = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    faces = merged.faces
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    merged.update_faces(distinct)  # slivers that the merging closed up
    _, uses = np.unique(merged.edges_sorted, axis=0, return_counts=True)
    if (uses % 2).any():
        raise ValueError(f"mesh must be closed, got {int((uses % 2).sum())} open edges")
    if not _two_sided(merged):
        trimesh.repair.fix_winding(merged)
        if not _two_sided(merged):
            raise ValueError("mesh must have an inside and an outside, but its faces cannot be wound consistently")
    triangles = np.array(merged.triangles, dtype=np.float64)
    volume = np.linalg.det(triangles - triangles.mean((0, 1))).sum() / 6  # of the tetrahedra below the triangles
    if abs(volume) <= 1e-12 * float(merged.extents.max()) ** 3:
        raise ValueError("mesh must enclose a volume, got none")
    return triangles if volume > 0 else triangles[:, ::-1]


def _two_sided(mesh: trimesh.Trimesh) -> bool:
    """Whether each edge is walked as often one way as the other."""
    forward = mesh.edges[:, 0] < mesh.edges[:, 1]
    _, inverse = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)
    return not np.bincount(inverse.ravel(), weights=np.where(forward, 1.0, -1.0)).any()

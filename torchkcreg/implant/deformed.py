"""The surface of an implant that has bent."""

from __future__ import annotations

from collections.abc import Callable

import torch
import trimesh
from torch import Tensor


def deformed_surface(
    warp: Callable[[Tensor], Tensor], mesh: trimesh.Trimesh, *, longest_edge_mm: float = 4.0
) -> trimesh.Trimesh:
    """The surface of a mesh where a mapping of points takes it.

    Long edges are split first: those of a flat side may run from end to end of a plate and could not bend. Chords of
    4 mm stay within 2 micrometres of a plate that bends by 3 degrees over 5 cm.

    Args:
        warp: Maps points (N, 3) of the mesh's frame, mm, float64.
        mesh: The surface at rest.
        longest_edge_mm: Edges are split until none is longer.

    Raises:
        ValueError: the length is not positive.
    """
    if not longest_edge_mm > 0:
        raise ValueError(f"longest_edge_mm must be positive, got {longest_edge_mm}")
    fine, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, longest_edge_mm, max_iter=20)
    vertices = warp(torch.tensor(fine, dtype=torch.float64, device="cpu")).detach().cpu().numpy()
    return trimesh.Trimesh(vertices, faces, process=False)

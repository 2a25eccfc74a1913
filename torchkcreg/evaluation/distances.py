"""Distances of points from nodes and surfaces, and properties of point clouds (spacing, volume or surface)."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

# Distance of a point of the unit cube from the cube's centre: mean (half the box integral B_3(1)),
# and root mean square (three times the variance 1/12 of a uniform number).
_MEAN_IN_CELL = 0.4802959782
_RMS_IN_CELL = 0.5
_BETWEEN_SURFACE_AND_BODY = 2.2  # dimension; surface and volume lattices give 1.7 and 2.7 over this short range


def nearest_node_distances(points: Tensor, nodes: Tensor) -> Tensor:
    """Distances (N,) in mm from each point (N, 3) to the nearest of the nodes (M, 3), float64.

    Between lattices it does not resolve small registration errors: see `nearest_node_floor`.

    Raises:
        ValueError: A cloud is empty, does not have shape (N, 3), or is not finite.

    >>> nearest_node_distances(torch.tensor([[0.0, 0.0, 0.2]]), torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    tensor([0.2000], dtype=torch.float64)
    """
    points, nodes = finite_cloud(points, "points"), finite_cloud(nodes, "nodes")
    distances, _ = cKDTree(nodes.numpy()).query(points.numpy())
    return torch.from_numpy(np.atleast_1d(distances))


def nearest_node_floor(pitch_mm: float) -> tuple[float, float]:
    """Smallest mean and RMS distance in mm from the nodes of a perfect cloud to those of another with this pitch.

    A node lies anywhere in a cell of the other lattice. Its distance from the node in the middle of the cell is 0.480
    pitches on average, 0.5 RMS and at most 0.866. At the paper's 0.25 mm that is 0.120 and 0.125 mm. (Lattices that
    happen to be parallel have anything from 0 to 0.866 pitches.)

    Raises:
        ValueError: The pitch is not positive.

    >>> nearest_node_floor(0.25)
    (0.12007399455, 0.125)
    """
    if not (math.isfinite(pitch_mm) and pitch_mm > 0):
        raise ValueError(f"pitch_mm must be a positive length, got {pitch_mm}")
    return _MEAN_IN_CELL * pitch_mm, _RMS_IN_CELL * pitch_mm


def node_spacing(nodes: Tensor, *, num_samples: int = 2000) -> float:
    """Pitch in mm of nodes (N, 3) on a lattice: the 0.9 quantile of the distances to the nearest neighbour.

    Not the median, because nodes at the surface may lie off the lattice, at the centroid of the metal in their cell.

    Raises:
        ValueError: There are fewer than two different nodes.
    """
    array = finite_cloud(nodes, "nodes").numpy()
    sample = array[np.linspace(0, len(array) - 1, min(len(array), num_samples)).round().astype(int)]
    spacing = float(np.quantile(cKDTree(array).query(sample, k=2)[0][:, 1], 0.9)) if len(array) > 1 else 0.0
    if not spacing > 0:
        raise ValueError(f"nodes must be at least two different points, got {len(array)}")
    return spacing


def surface_distances(points: Tensor, mesh: trimesh.Trimesh) -> Tensor:
    """Distances (N,) in mm from each point (N, 3) to the nearest point of a surface, float64, never negative.

    Raises:
        ValueError: The cloud is empty, does not have shape (N, 3) or is not finite, or the mesh has no faces.

    >>> box = trimesh.creation.box((2.0, 2.0, 2.0))
    >>> surface_distances(torch.tensor([[0.0, 0.0, 1.25], [0.0, 0.0, 0.5], [4.0, 5.0, 0.0]]), box).tolist()
    [0.25, 0.5, 5.0]
    """
    return closest_on_surface(points, mesh)[1]


def closest_on_surface(points: Tensor, mesh: trimesh.Trimesh) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest points (N, 3) of a surface, their distances (N,), and normals (N, 3) of the faces they lie on."""
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise ValueError(f"mesh must have faces and finite vertices, got {len(mesh.faces)} faces")
    closest, distances, faces = trimesh.proximity.closest_point(mesh, finite_cloud(points, "points").numpy())
    normals = np.asarray(mesh.face_normals)[faces]
    closest, distances, normals = (np.array(array, dtype=np.float64) for array in (closest, distances, normals))
    return torch.from_numpy(closest), torch.from_numpy(distances), torch.from_numpy(normals)


def fills_volume(points: Tensor, *, num_samples: int = 1000) -> bool:
    """True if points (N, 3) fill a volume like nodes, False if they cover a surface like an optical scan.

    Decided by the correlation dimension (Grassberger & Procaccia 1983) between 1.5 and 3 times the spacing: about 2
    for a surface and 3 for a volume. A scan whose noise exceeds its spacing looks like a volume.

    >>> line = torch.arange(9.0)
    >>> fills_volume(torch.cartesian_prod(line, line, line)), fills_volume(torch.cartesian_prod(line, line, line[:1]))
    (True, False)
    """
    array, spacing = finite_cloud(points, "points").numpy(), node_spacing(points)
    tree = cKDTree(array)
    sample = array[np.linspace(0, len(array) - 1, min(len(array), num_samples)).round().astype(int)]
    near, far = (
        np.mean(tree.query_ball_point(sample, reach * spacing, return_length=True)) for reach in (1.5001, 3.0001)
    )
    return bool(np.log2(far / near) > _BETWEEN_SURFACE_AND_BODY)


def outermost_nodes(nodes: Tensor, *, num_samples: int = 50_000) -> Tensor:
    """Nodes (n, 3) at the surface of a body's cloud (N, 3), out of a sample of its nodes.

    The 26 nearest neighbours of an inner lattice node surround it. At the surface their centroid is more than a quarter
    of the spacing away from the node.
    """
    array = finite_cloud(nodes, "nodes").numpy()
    sample = array[np.linspace(0, len(array) - 1, min(len(array), num_samples)).round().astype(int)]
    _, neighbours = cKDTree(array).query(sample, k=min(27, len(array)))
    offset = np.linalg.norm(array[neighbours].mean(axis=1) - sample, axis=1)
    return torch.from_numpy(sample[offset > 0.25 * node_spacing(nodes)])


def finite_cloud(points: Tensor, name: str) -> Tensor:
    """The points (N, 3) on the CPU in float64.

    Raises:
        ValueError: The shape is not (N, 3), there is no point, or a point is not finite.
    """
    if points.ndim != 2 or points.shape[-1] != 3 or len(points) == 0:
        raise ValueError(f"{name} must have shape (N, 3) with N > 0, got {tuple(points.shape)}")
    cloud = points.detach().cpu().double()
    finite = cloud.isfinite().all(-1)
    if not bool(finite.all()):
        raise ValueError(f"{name} must be finite, but row {int((~finite).nonzero()[0])} is not")
    return cloud

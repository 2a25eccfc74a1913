"""Implants on voxel grids: metal fraction of each voxel, from a mesh (exact) or from a point cloud."""

from __future__ import annotations

import itertools
import math

import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import VolumeGrid, transform_points

from .closed_mesh import closed_triangles
from .partial_volumes import fill_cells


def voxelize_mesh(mesh: trimesh.Trimesh, grid: VolumeGrid, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """Fraction of each voxel inside a closed mesh, (D, H, W); exact, including partial volumes.

    Args:
        mesh: Closed surface in world coordinates, mm.
        grid: Voxel grid; parts of the mesh outside it are ignored.
        dtype: Dtype of the result.

    Raises:
        ValueError: If the mesh is open or encloses no volume.

    >>> box = trimesh.creation.box((1.0, 2.0, 2.5))
    >>> voxelize_mesh(box, VolumeGrid.centered((5, 4, 3), 1.0))[:, 1, 1].tolist()
    [0.0, 0.75, 1.0, 0.75, 0.0]
    """
    moved = mesh.copy() if isinstance(mesh, trimesh.Trimesh) else mesh
    if isinstance(moved, trimesh.Trimesh):
        moved.apply_transform(grid.world_to_voxel.numpy())
    indices, fractions, _ = fill_cells(closed_triangles(moved) + 0.5)
    depth, height, width = grid.shape
    inside = ((indices >= 0) & (indices < [width, height, depth])).all(1)
    i, j, k = torch.from_numpy(indices[inside]).unbind(1)
    volume = torch.zeros(grid.shape, dtype=torch.float64)
    volume[k, j, i] = torch.from_numpy(fractions[inside])
    return volume.to(dtype)


def voxelize_points(points: Tensor, volumes: Tensor, grid: VolumeGrid, *, cell: Tensor | None = None) -> Tensor:
    """Fraction of each voxel that the nodes of a cloud fill, (D, H, W); differentiable in points and volumes.

    Each node is cut into parts no larger than a voxel, and each part is shared among the eight voxels around it with
    trilinear weights. Total volume and centroid are preserved, but edges blur by about a voxel.

    Args:
        points: (N, 3) in world coordinates, mm, after any deformation.
        volumes: (N,) in mm^3.
        grid: Voxel grid; volume outside it is lost.
        cell: (3, 3) edges of the nodes' cells in rows, in world coordinates, mm; nodes are points if not given.

    >>> half = voxelize_points(torch.zeros(1, 3), torch.ones(1), VolumeGrid.centered((1, 1, 2), 1.0))
    >>> half.tolist()
    [[[0.5, 0.5]]]
    """
    if points.ndim != 2 or points.shape[1] != 3 or volumes.shape != points.shape[:1]:
        raise ValueError(
            f"points and volumes must have shapes (N, 3) and (N,), got {tuple(points.shape)} and {tuple(volumes.shape)}"
        )
    to_voxel = grid.world_to_voxel.to(points)
    voxels = transform_points(to_voxel, points)
    edges = torch.zeros_like(to_voxel[:3, :3]) if cell is None else cell.to(points) @ to_voxel[:3, :3].mT
    parts = [max(1, math.ceil(edge - 1e-4)) for edge in edges.detach().abs().amax(1).tolist()]
    shares = volumes / (math.prod(parts) * grid.voxel_volume)
    volume = torch.zeros(grid.num_voxels, dtype=points.dtype, device=points.device)
    for part in itertools.product(*(range(count) for count in parts)):
        offset = points.new_tensor([(i + 0.5) / count - 0.5 for i, count in zip(part, parts)])
        volume = volume + _deposit(voxels + offset @ edges, shares, grid)
    return volume.reshape(grid.shape)


def _deposit(voxels: Tensor, shares: Tensor, grid: VolumeGrid) -> Tensor:
    """Sum of shares (N,) at voxel coordinates (N, 3), distributed with trilinear weights, (D H W,)."""
    depth, height, width = grid.shape
    size = torch.tensor([width, height, depth], device=voxels.device)
    low = voxels.detach().floor()
    upper = voxels - low
    volume = torch.zeros(grid.num_voxels, dtype=voxels.dtype, device=voxels.device)
    for corner in itertools.product((0, 1), repeat=3):
        step = torch.tensor(corner, device=voxels.device)
        index = low.long() + step
        weight = torch.where(step.bool(), upper, 1 - upper).prod(-1)
        inside = ((index >= 0) & (index < size)).all(-1)
        flat = (index[:, 2] * height + index[:, 1]) * width + index[:, 0]
        volume = volume.index_add(0, flat[inside], (weight * shares)[inside])
    return volume

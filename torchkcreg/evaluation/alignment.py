"""Rigid alignment of shapes: coherent point drift, point-to-plane refinement, principal axes, frame changes."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from pycpd import RigidRegistration
from torch import Tensor

from torchkcreg.geometry import fit_rigid, principal_axes, rigid_matrix, transform_points

from .distances import closest_on_surface, finite_cloud

_CPD_POINTS = 700  # time and memory grow with the square of it
_CPD_ITERATIONS = 60
_POINTS_PER_BLOCK = 60
_SURFACE_POINTS = 4000
_SETTLED_MM = 1e-4


def rigid_coherent_point_drift(
    moving: Tensor, fixed: Tensor, *, num_points: int = _CPD_POINTS, iterations: int = _CPD_ITERATIONS
) -> Tensor:
    """Rigid motion (4, 4) from one point cloud to another by coherent point drift (Myronenko & Song 2010).

    Uses the library pycpd, with the scale fixed at one. Correspondences are soft, so that it converges from far away.
    Its cost grows with N M, so both clouds are thinned. This limits the accuracy to some tenths of a mm for an
    implant; `align_to_surface` refines the result.

    Args:
        moving: Point cloud (N, 3) to be moved, mm.
        fixed: Point cloud (M, 3) to move it to, mm.
        num_points: Approximate number of points used of each cloud, merged on a lattice. Smaller clouds are used whole.
        iterations: Largest number of iterations.

    Raises:
        ValueError: A cloud is empty, does not have shape (N, 3), or is not finite.

    >>> corner = torch.tensor([[0.0, 0, 0], [9, 0, 0], [0, 5, 0], [0, 0, 2]])
    >>> motion = rigid_coherent_point_drift(corner + torch.tensor([0.5, -1, 0]), corner)
    >>> [round(x, 3) + 0.0 for x in motion[:3, 3].tolist()]
    [-0.5, 1.0, 0.0]
    """
    moving, fixed = finite_cloud(moving, "moving"), finite_cloud(fixed, "fixed")
    center = fixed.mean(0)  # about the centroid, rotation and translation are least correlated
    drift = _Rigid(
        X=(merged(fixed, num_points) - center).numpy(),
        Y=(merged(moving, num_points) - center).numpy(),
        max_iterations=iterations,
    )
    drift.register()
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.from_numpy(np.asarray(drift.R).T.copy())  # pycpd multiplies rows from the right
    motion[:3, 3] = torch.from_numpy(np.asarray(drift.t).ravel()) + center - motion[:3, :3] @ center
    return motion


class _Rigid(RigidRegistration):
    """pycpd's rigid registration with the scale fixed at one; pycpd itself estimates it."""

    q: float
    sigma2: float

    def update_transform(self) -> None:
        super().update_transform()
        self.s = 1.0
        self.t = (self.Pt1 @ self.X - self.P1 @ self.Y @ self.R)[None] / self.Np

    def update_variance(self) -> None:
        """Update the variance for a scale of one (fig. 2 of Myronenko & Song 2010 assumes the optimal scale)."""
        before, fit = self.q, float(np.trace(self.A @ self.R))
        residual = float(self.Pt1 @ np.sum(self.X_hat**2, axis=1)) - 2 * fit + float(self.YPY)
        self.q = residual / (2 * self.sigma2) + self.D * self.Np / 2 * np.log(self.sigma2)
        self.diff = abs(self.q - before)
        self.sigma2 = max(residual / (self.Np * self.D), self.tolerance / 10)


def align_to_surface(
    points: Tensor,
    mesh: trimesh.Trimesh,
    *,
    inset: bool = False,
    iterations: int = 30,
    num_points: int = _SURFACE_POINTS,
) -> Tensor:
    """Rigid motion (4, 4) that fits points (N, 3) to a surface, by least squares of their distances from it.

    Point-to-plane ICP (Chen & Medioni 1992): flat faces slide freely along each other, where point-to-point distances
    would hold them back. The start must be right within a few mm, as coherent point drift gives it.

    Args:
        points: Points on or near the surface, mm.
        mesh: The surface.
        inset: True if the points lie inside the surface by the same unknown depth everywhere, as the outermost nodes of
            a voxel grid do. The depth is estimated too.
        iterations: Largest number of iterations.
        num_points: Largest number of points used.

    Raises:
        ValueError: The cloud is empty, does not have shape (N, 3) or is not finite, or the mesh has no faces.
    """
    points = thinned(finite_cloud(points, "points"), num_points)
    center = points.mean(0)
    motion = torch.eye(4, dtype=torch.float64)
    for _ in range(iterations):
        moved = transform_points(motion, points)
        closest, _, normals = closest_on_surface(moved, mesh)
        heights = ((moved - closest) * normals).sum(-1)
        middle = transform_points(motion, center[None])[0]
        arms = torch.linalg.cross(moved - middle, normals)
        columns = [arms, normals, torch.ones_like(heights)[:, None]] if inset else [arms, normals]
        solution = torch.linalg.lstsq(torch.cat(columns, dim=-1), -heights[:, None], driver="gelsd").solution[:, 0]
        step = rigid_matrix(solution[:3], solution[3:6])
        step[:3, 3] += middle - step[:3, :3] @ middle
        motion = step @ motion
        if float((transform_points(motion, points) - moved).norm(dim=-1).max()) < _SETTLED_MM:
            break
    return motion


def thinned(points: Tensor, num_points: int) -> Tensor:
    """At most `num_points` of the points (N, 3), a random choice that is the same each time."""
    if len(points) <= num_points:
        return points
    chosen = np.random.default_rng(0).permutation(len(points))[:num_points]
    return points[torch.from_numpy(np.sort(chosen))]


def merged(points: Tensor, num_points: int) -> Tensor:
    """Centroids of the points (N, 3) in blocks of a lattice, about `num_points`; all points if fewer.

    For soft correspondences this is much better than a random choice, as each block is represented by its centroid.
    """
    if len(points) <= num_points:
        return points
    points = thinned(points, _POINTS_PER_BLOCK * num_points)
    low, size = points.amin(0), points.amax(0) - points.amin(0)
    edge = float(size.max()) / 4
    while True:
        cells = ((points - low) / edge).floor().long()
        _, rows, layers = (cells.amax(0) + 1).tolist()
        blocks, block = torch.unique((cells[:, 0] * rows + cells[:, 1]) * layers + cells[:, 2], return_inverse=True)
        if len(blocks) >= num_points:
            break
        edge *= 0.93
    sums = points.new_zeros(len(blocks), 3).index_add_(0, block, points)
    return sums / torch.bincount(block, minlength=len(blocks))[:, None]


def principal_motions(moving: Tensor, fixed: Tensor) -> list[Tensor]:
    """The four rigid motions (4, 4) that align centroid and principal axes of a cloud (N, 3) with those of another."""
    (center, axes), (target, target_axes) = _principal_frame(moving), _principal_frame(fixed)
    motions = []
    for signs in ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)):
        motion = torch.eye(4, dtype=torch.float64)
        motion[:3, :3] = target_axes @ torch.diag(torch.tensor(signs, dtype=torch.float64)) @ axes.mT
        motion[:3, 3] = target - motion[:3, :3] @ center
        motions.append(motion)
    return motions


def _principal_frame(points: Tensor) -> tuple[Tensor, Tensor]:
    """Centroid (3,) and principal axes (3, 3) in columns, a proper rotation."""
    center, rows = principal_axes(points)
    axes = rows.mT.clone()
    axes[:, 0] *= torch.linalg.det(axes).sign()
    return center, axes


def frame_changes(mesh: trimesh.Trimesh, other: trimesh.Trimesh, *, tolerance_mm: float = 0.1) -> list[Tensor]:
    """Rigid motions (4, 4) from the frame of a mesh to that of another mesh of the same body.

    One motion if both have the same vertices in the same order. Otherwise all motions that align the surfaces; a
    symmetric body has several.

    Args:
        mesh: A closed surface, mm.
        other: The same body in another frame; its vertices and faces may differ.
        tolerance_mm: Largest root mean square distance between surfaces of the same body.

    Raises:
        ValueError: If the two are not the same body.
    """
    points, targets = (torch.from_numpy(np.array(m.vertices, dtype=np.float64)) for m in (mesh, other))
    if points.shape == targets.shape:
        motion = fit_rigid(points, targets)
        if float((transform_points(motion, points) - targets).norm(dim=-1).max()) < tolerance_mm:
            return [motion]
    samples = torch.from_numpy(np.array(trimesh.sample.sample_surface(mesh, _SURFACE_POINTS, seed=0)[0]))
    onto = torch.from_numpy(np.array(trimesh.sample.sample_surface(other, _SURFACE_POINTS, seed=0)[0]))
    motions, nearest = [], float("inf")
    for start in principal_motions(samples, onto):
        motion = align_to_surface(transform_points(start, samples), other) @ start
        _, distance, _ = closest_on_surface(transform_points(motion, samples), other)
        off = float(distance.square().mean().sqrt())
        nearest = min(nearest, off)
        if off < tolerance_mm:
            motions.append(motion)
    if not motions:
        raise ValueError(f"the two meshes are not of the same implant: their surfaces are {nearest:.2f} mm apart (RMS)")
    return motions

"""Signs of projection matrices: P and -P define the same rays, in opposite directions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_LEAST_ANGLE = 1e-3  # rad between central rays; below it their intersection is undetermined
_AT_SOURCE = 1e-3  # share of the largest depth; nearer points count as at the source
_FURTHEST = 0.5  # largest distance of central rays from their meeting point, relative to its distance from the source


def checked_shape(det_shape: Sequence[int]) -> tuple[int, int]:
    """A detector's (rows, cols) as integers; ValueError if invalid."""
    if len(det_shape) != 2 or any(int(n) != n or n < 1 for n in det_shape):
        raise ValueError(f"det_shape must be two positive integers (rows, cols), got {tuple(det_shape)}")
    return int(det_shape[0]), int(det_shape[1])


def checked_matrices(matrices: Tensor) -> Tensor:
    """Projection matrices (V, 3, 4) in float64 with unit normals in row 2; ValueError if invalid."""
    given = matrices if isinstance(matrices, Tensor) else torch.as_tensor(matrices, device="cpu")
    matrices = given.double()
    if matrices.ndim != 3 or tuple(matrices.shape[1:]) != (3, 4) or len(matrices) == 0:
        raise ValueError(f"projection_matrices must have shape (V, 3, 4), got {tuple(matrices.shape)}")
    if not bool(matrices.isfinite().all()):
        raise ValueError("projection_matrices must be finite")
    rows = matrices[:, :, :3] / matrices[:, :, :3].norm(dim=-1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    if bool((torch.linalg.det(rows).abs() < 1e-9).any()):
        raise ValueError("projection_matrices must have an invertible left 3 x 3 part")
    return matrices / matrices[:, 2:, :3].norm(dim=-1, keepdim=True)


def looking_signs(matrices: Tensor, det_shape: tuple[int, int]) -> tuple[Tensor, bool]:
    """Signs (V,) that make depths positive in front of the source, and True if they follow from the views.

    Views of one object point at it: their central rays (through the detector centres) pass near a common point, which
    is in front of all sources. If there is no such point (one view, parallel views, a source that only rotates in
    place), the world's origin is taken to be in front. If the origin is at the source, the matrix keeps its sign.

    Args:
        matrices: (V, 3, 4), float64, row 2 with a unit normal.
        det_shape: (rows, cols).
    """
    point = _meeting_point(matrices, det_shape)
    if point is not None:
        depths = _depths_of(matrices, point[None])[:, 0]
        if bool((depths.abs() > _AT_SOURCE * depths.abs().max()).all()):
            return depths.sign(), True
    at_origin = matrices[:, 2, 3]
    from_source = torch.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:]).squeeze(-1).norm(dim=-1)
    known = at_origin.abs() > 1e-9 * from_source.clamp_min(1e-9)
    return torch.where(known, at_origin.sign(), torch.ones_like(at_origin)), False


def turned_towards(matrices: Tensor, points: Tensor, *, keep: bool) -> Tensor:
    """Matrices (V, 3, 4) with signs such that world points (N, 3) are in front of the sources.

    Args:
        matrices: (V, 3, 4), float64, row 2 with a unit normal.
        points: Positions in mm.
        keep: True if the signs are known and must not change.

    Raises:
        ValueError: A point lies at or behind a source.
    """
    points = points.to(matrices)
    if not keep:
        depth = _depths_of(matrices, points.mean(0, keepdim=True))
        matrices = matrices * torch.where(depth < 0, -1.0, 1.0)[..., None]
    nearest = _depths_of(matrices, points).amin(-1)
    if behind := (nearest <= 0).nonzero().flatten().tolist():
        raise ValueError(
            f"the object lies behind the X-ray source of view {', '.join(map(str, behind))} "
            f"(depth {float(nearest.min()):.0f} mm): check its frame, its unit and its pose"
        )
    return matrices


def _depths_of(matrices: Tensor, points: Tensor) -> Tensor:
    """Depths (V, N) of points (N, 3)."""
    return matrices[:, 2, :3] @ points.mT + matrices[:, 2, 3:]


def _meeting_point(matrices: Tensor, det_shape: tuple[int, int]) -> Tensor | None:
    """Least-squares intersection (3,) of the central rays; None if they are near parallel or do not meet."""
    rows, cols = det_shape
    middle = matrices.new_tensor([(cols - 1) / 2, (rows - 1) / 2, 1.0])
    inverse = torch.linalg.inv(matrices[:, :, :3])
    sources = -(inverse @ matrices[:, :, 3:]).squeeze(-1)
    along = inverse @ middle
    along = along / along.norm(dim=-1, keepdim=True)
    across = torch.eye(3, dtype=matrices.dtype, device=matrices.device) - along[:, :, None] * along[:, None, :]
    mean = across.mean(0)
    if not bool(mean.isfinite().all()) or float(torch.linalg.eigvalsh(mean)[0]) < _LEAST_ANGLE**2:
        return None
    point = torch.linalg.solve(mean, (across @ sources[:, :, None]).mean(0)).squeeze(-1)
    missed = (across @ (point - sources)[:, :, None]).squeeze(-1).norm(dim=-1)
    distance = (point - sources).norm(dim=-1)
    return point if bool((missed <= _FURTHEST * distance).all()) else None

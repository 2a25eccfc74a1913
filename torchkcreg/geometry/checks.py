"""What makes numbers a view: checked, and brought to one form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def checked_shape(det_shape: Sequence[int]) -> tuple[int, int]:
    """A detector's (rows, cols); ValueError where they are none."""
    if len(det_shape) != 2 or any(int(n) != n or n < 1 for n in det_shape):
        raise ValueError(f"det_shape must be two positive integers (rows, cols), got {tuple(det_shape)}")
    return int(det_shape[0]), int(det_shape[1])


def checked_matrices(matrices: Tensor) -> Tensor:
    """Projection matrices (V, 3, 4) in float64 with unit normals in row 2; ValueError where they are none."""
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

"""Small rigid motions of points."""

from __future__ import annotations

import torch
from torch import Tensor


def rigid_fields(positions: Tensor) -> Tensor:
    """Displacements (6, N, 3) of positions (N, 3) by a unit shift along each axis, and a unit small turn about each."""
    axes = torch.eye(3, dtype=positions.dtype, device=positions.device)
    shifts = axes[:, None].expand(3, len(positions), 3)
    turns = torch.linalg.cross(axes[:, None].expand_as(shifts), positions[None].expand_as(shifts))
    return torch.cat([shifts, turns])

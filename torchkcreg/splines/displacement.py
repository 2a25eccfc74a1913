"""Displacements of points by a spline on control points (CPs): eq. 2 and 3 of Cao et al. 2020."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid

from .basis import SplineBasis
from .grid import ControlPointGrid


def spline_displacement(
    grid: ControlPointGrid, control_points: Tensor, points: Tensor, *, labels: Tensor | None = None
) -> Tensor:
    """Displacements of points by a cubic B-spline, in the implant's frame, mm (eq. 2 of Cao et al. 2020).

    u(x) = sum_lmn B_l B_m B_n phi[c + (l, m, n)]. CPs outside the grid are virtual: each belongs to the group of the
    nearest real CP and moves with that group's rigid motion, the least-squares fit of c -> c + phi_c over the group's
    real CPs. So far from the grid the field is the rigid motion of the nearest group.

    Args:
        grid: Control points.
        control_points: Displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        points: Points in the implant's frame, mm, shape (..., N, 3) or (3,).
        labels: Group of each CP, (nx, ny, nz) long. None: a single group.

    Returns:
        Tensor of shape (leading axes of `control_points`) + (shape of `points`), in the dtype of `points`.

    Raises:
        ValueError: If shapes do not match, or a point is not finite.

    Example:
        >>> grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
        >>> phi = torch.tensor([1.0, 2.0, 3.0]).expand(4, 4, 4, 3)
        >>> spline_displacement(grid, phi, torch.tensor([[15.0, 15.0, 15.0], [900.0, 0.0, 0.0]])).round(decimals=3)
        tensor([[1., 2., 3.],
                [1., 2., 3.]])
    """
    if control_points.shape[-4:] != (*grid.shape, 3):
        raise ValueError(f"control_points must have shape (..., {grid.shape}, 3), got {tuple(control_points.shape)}")
    if points.numel() == 0:
        return points.new_zeros(*control_points.shape[:-4], *points.shape)
    basis = SplineBasis(grid, points.reshape(-1, 3))
    u = basis.evaluate(cell_features(grid, basis, control_points, labels))
    candidates = control_points.shape[:-4]
    u = grid.to_implant(u.reshape(len(u), -1, 3)).movedim(0, 1)
    return u.reshape(*candidates, *points.shape)


def group_rigid_motions(grid: ControlPointGrid, control_points: Tensor, labels: Tensor) -> Tensor:
    """Rigid motion (..., G, 4, 4) in the grid's frame that best fits c -> c + phi_c over each group's real CPs.

    Args:
        grid: Control points.
        control_points: Displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        labels: Group of each CP, (nx, ny, nz) long. Every group from 0 to G - 1 must occur.
    """
    positions = grid.positions().to(control_points).reshape(1, -1, 3)
    moved = positions + control_points.flatten(-4, -2).unsqueeze(-3)
    members = torch.nn.functional.one_hot(labels.flatten()).T.to(positions)
    return fit_rigid(positions, moved, members)


def cell_features(grid: ControlPointGrid, basis: SplineBasis, control_points: Tensor, labels: Tensor | None) -> Tensor:
    """Displacements of the CPs of each cell, virtual ones included, for all candidates: (num_cells, 64, K * 3)."""
    phi = control_points.reshape(-1, grid.num_control_points, 3)
    indices, nearest = basis.control_points()
    values = phi[:, nearest.flatten()]
    positions = indices.reshape(-1, 3) * torch.tensor(grid.spacing, dtype=phi.dtype, device=phi.device)
    real = grid.positions().to(phi).reshape(-1, 3)[nearest.flatten()]
    virtual = (positions != real).any(-1).nonzero().squeeze(-1)
    if len(virtual):
        labels = torch.zeros(grid.shape, dtype=torch.long, device=phi.device) if labels is None else labels
        # Renumber the labels in use: a group without real CPs has no motion.
        groups = torch.unique(labels, return_inverse=True)[1]
        motions = group_rigid_motions(grid, phi.reshape(-1, *grid.shape, 3), groups)
        motions = motions[:, groups.flatten()[nearest.flatten()[virtual]]]
        here = positions[virtual]
        continued = (motions[..., :3, :3] @ here[:, :, None]).squeeze(-1) + motions[..., :3, 3] - here
        values = values.index_copy(1, virtual, continued)
    return values.movedim(0, 1).reshape(len(basis.cells), 64, -1).to(basis.eta.dtype)

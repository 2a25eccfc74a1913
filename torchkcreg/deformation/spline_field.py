"""A cubic B-spline displacement field around an implant (eq. 2 and 3 of Cao et al. 2020)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.deformation.basis import SplineBasis
from torchkcreg.deformation.grid import ControlPointGrid
from torchkcreg.deformation.model import Deformation
from torchkcreg.geometry import fit_rigid, invert_rigid, transform_points


def spline_displacement(
    grid: ControlPointGrid, control_points: Tensor, points: Tensor, *, labels: Tensor | None = None
) -> Tensor:
    """Displacements of points by a cubic B-spline, in the implant's frame, mm (eq. 2 of Cao et al. 2020).

    u(x) = sum_lmn B_l B_m B_n phi[c + (l, m, n)]. Where a CP would lie beyond the grid a virtual one stands in: it
    belongs to the group of the nearest real CP and moves with that group's rigid motion, the least-squares fit of
    c -> c + phi_c over the group's real CPs. Far from the grid the field thus is the nearest group's rigid motion.

    Args:
        grid: control points.
        control_points: displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        points: in the implant's frame, mm, shape (..., N, 3) or (3,).
        labels: group of each CP, (nx, ny, nz) long; one group if not given.

    Returns:
        Tensor of shape (leading axes of `control_points`) + (shape of `points`), in the dtype of `points`.

    Raises:
        ValueError: if shapes do not fit, or a point is not finite.

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
    u = basis.evaluate(_cell_features(grid, basis, control_points, labels))
    candidates = control_points.shape[:-4]
    u = grid.to_implant(u.reshape(len(u), -1, 3)).movedim(0, 1)
    return u.reshape(*candidates, *points.shape)


def group_rigid_motions(grid: ControlPointGrid, control_points: Tensor, labels: Tensor) -> Tensor:
    """Rigid motion (..., G, 4, 4) in the grid's frame that fits c -> c + phi_c best for each group's real CPs.

    Args:
        grid: control points.
        control_points: displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        labels: group of each CP, (nx, ny, nz) long, with every group from 0 to G - 1.
    """
    positions = grid.positions().to(control_points).reshape(1, -1, 3)
    moved = positions + control_points.flatten(-4, -2).unsqueeze(-3)
    members = torch.nn.functional.one_hot(labels.flatten()).T.to(positions)
    return fit_rigid(positions, moved, members)


class SplineField(Deformation):
    """The displacement field of a lattice of control points, as a module: eq. 2 of Cao et al. 2020.

    Args:
        grid: control points (CPs).
        control_points: initial displacements, mm, in the grid's axes, shape (nx, ny, nz, 3); zero if not given.
        labels: group of each CP, shape (nx, ny, nz); one group if not given. Only the continuation beyond the grid
            depends on it.

    Raises:
        ValueError: if shapes do not fit.

    Attributes:
        control_points: parameter phi, (nx, ny, nz, 3), float64 unless given otherwise.
        labels: buffer (nx, ny, nz), long.
    """

    labels: Tensor

    def __init__(
        self,
        grid: ControlPointGrid,
        control_points: Tensor | None = None,
        labels: Tensor | None = None,
    ) -> None:
        super().__init__()
        if control_points is None:
            control_points = torch.zeros(*grid.shape, 3, dtype=torch.float64, device=grid.frame.device)
        if labels is None:
            labels = torch.zeros(grid.shape, dtype=torch.long, device=control_points.device)
        if control_points.shape != (*grid.shape, 3):
            raise ValueError(f"control_points must have shape {(*grid.shape, 3)}, got {tuple(control_points.shape)}")
        if labels.shape != grid.shape:
            raise ValueError(f"labels must have shape {grid.shape}, got {tuple(labels.shape)}")
        self.grid = grid
        self.control_points = nn.Parameter(control_points.detach().clone())
        self.register_buffer("labels", labels.long().clone())

    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame; see `spline_displacement`."""
        return spline_displacement(self.grid, self.control_points, points, labels=self.labels)

    def jacobian(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) of x -> x + u(x) in the implant's frame, [i, j] = d (x + u)_i / d x_j."""
        basis = SplineBasis(self.grid, points.reshape(-1, 3))
        features = _cell_features(self.grid, basis, self.control_points, self.labels)
        orders = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        slopes = [basis.evaluate(features, o) / s for o, s in zip(orders, self.grid.spacing, strict=True)]
        frame = self.grid.frame[:3, :3].to(points)
        jacobian = torch.eye(3).to(points) + frame @ torch.stack(slopes, dim=-1) @ frame.T
        return jacobian.reshape(*points.shape, 3)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) beyond the valid domain of the grid, which move with the nearest group."""
        return ~self.grid.contains(points)

    @property
    def num_groups(self) -> int:
        """Groups that the control points have been split into so far."""
        return int(self.labels.max()) + 1

    @torch.no_grad()
    def remove_common_rigid(self, weights: Tensor | None = None) -> Tensor:
        """Rigid transform C (4, 4), float64, in the implant's frame, that has been moved out of the control points.

        C is the rigid motion that fits c -> c + phi_c best. The control points become phi'_c = C^-1 (c + phi_c) - c,
        so that x + u(x) = C (x + u'(x)) exactly: B-splines reproduce rigid motions. (Beyond the grid this needs groups
        whose CPs do not all lie on a line, for the rigid motion of such a group is ambiguous.)

        Args:
            weights: shape (nx, ny, nz), how much each CP counts in the fit, such as the implant volume that it carries
                (`control_point_volumes`); all alike if not given. The identity above holds for any.
        """
        positions = self.grid.positions().to(self.control_points.device).reshape(-1, 3)
        moved = positions + self.control_points.detach().double().reshape(-1, 3)
        common = fit_rigid(positions, moved, None if weights is None else weights.detach().flatten())
        rest = transform_points(invert_rigid(common), moved) - positions
        self.control_points.copy_(rest.reshape(self.control_points.shape))
        frame = self.grid.frame.to(common)
        return frame @ common @ invert_rigid(frame)

    @torch.no_grad()
    def reset(self) -> None:
        """Takes all bending back."""
        self.control_points.zero_()
        self.labels.zero_()

    def to_dict(self) -> dict[str, Any]:
        """Grid, displacements and groups of the control points."""
        return {
            "model": self.model,
            "grid": self.grid.to_dict(),
            "control_points_mm": self.control_points.detach(),
            "labels": self.labels,
        }

    def description(self) -> list[float]:
        """Shape, spacing and frame of the grid."""
        grid = self.grid
        return [float(n) for n in (*grid.shape, *grid.spacing, *grid.frame.flatten().tolist())]

    def extra_repr(self) -> str:
        """Shape and spacing of the grid."""
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}"


def _cell_features(grid: ControlPointGrid, basis: SplineBasis, control_points: Tensor, labels: Tensor | None) -> Tensor:
    """Displacements of the CPs of each cell, virtual ones included, for all candidates: (num_cells, 64, K * 3)."""
    phi = control_points.reshape(-1, grid.num_control_points, 3)
    indices, nearest = basis.control_points()
    values = phi[:, nearest.flatten()]
    positions = indices.reshape(-1, 3) * torch.tensor(grid.spacing, dtype=phi.dtype, device=phi.device)
    real = grid.positions().to(phi).reshape(-1, 3)[nearest.flatten()]
    virtual = (positions != real).any(-1).nonzero().squeeze(-1)
    if len(virtual):
        labels = torch.zeros(grid.shape, dtype=torch.long, device=phi.device) if labels is None else labels
        # Labels in use, renumbered: a group without real CPs has no motion.
        groups = torch.unique(labels, return_inverse=True)[1]
        motions = group_rigid_motions(grid, phi.reshape(-1, *grid.shape, 3), groups)
        motions = motions[:, groups.flatten()[nearest.flatten()[virtual]]]
        here = positions[virtual]
        continued = (motions[..., :3, :3] @ here[:, :, None]).squeeze(-1) + motions[..., :3, 3] - here
        values = values.index_copy(1, virtual, continued)
    return values.movedim(0, 1).reshape(len(basis.cells), 64, -1).to(basis.eta.dtype)

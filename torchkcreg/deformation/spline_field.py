"""A cubic B-spline displacement field around an implant, as a module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.geometry import fit_rigid, invert_rigid, transform_points
from torchkcreg.splines import ControlPointGrid, SplineBasis, cell_features, spline_displacement

from .deformation import Deformation


class SplineField(Deformation):
    """Displacement field of a lattice of control points, as a module (eq. 2 of Cao et al. 2020).

    Args:
        grid: Control points (CPs).
        control_points: Initial displacements, mm, in the grid's axes, shape (nx, ny, nz, 3); zero if not given.
        labels: Group of each CP, shape (nx, ny, nz); one group if not given. Only the extrapolation beyond the grid
            depends on it.

    Raises:
        ValueError: If shapes do not fit.

    Attributes:
        control_points: Parameter phi, (nx, ny, nz, 3), float64 unless another dtype is given.
        labels: Buffer (nx, ny, nz), long.
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
        self.register_load_state_dict_pre_hook(_with_grid)

    def get_extra_state(self) -> Tensor:
        """Shape, spacing and frame of the grid, in the state dict: control points mean nothing without it."""
        return torch.tensor(self.description(), dtype=torch.float64, device="cpu")

    def set_extra_state(self, state: Tensor) -> None:
        """Check that a state dict is of this grid.

        Raises:
            ValueError: If its control points are those of another grid.
        """
        own = self.get_extra_state()
        if state.shape != own.shape or not torch.allclose(state.to(own), own, rtol=1e-9, atol=1e-6):
            spacing = ", ".join(f"{step:g}" for step in state.flatten()[3:6].tolist())
            raise ValueError(f"the state is of another grid (spacing {spacing} mm) than this deformation's {self.grid}")

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> SplineField:
        super()._apply(fn, recurse)
        self.grid = self.grid.to(self.control_points.device)
        return self

    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame; see `spline_displacement`."""
        return spline_displacement(self.grid, self.control_points, points, labels=self.labels)

    def jacobian(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) of x -> x + u(x) in the implant's frame, [i, j] = d (x + u)_i / d x_j."""
        basis = SplineBasis(self.grid, points.reshape(-1, 3))
        features = cell_features(self.grid, basis, self.control_points, self.labels)
        orders = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        slopes = [basis.evaluate(features, o) / s for o, s in zip(orders, self.grid.spacing, strict=True)]
        frame = self.grid.frame[:3, :3].to(points)
        jacobian = (
            torch.eye(3, dtype=points.dtype, device=points.device) + frame @ torch.stack(slopes, dim=-1) @ frame.T
        )
        return jacobian.reshape(*points.shape, 3)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) beyond the valid domain of the grid; they move with the nearest group."""
        return ~self.grid.contains(points)

    @property
    def num_groups(self) -> int:
        """Number of groups of the control points."""
        return int(self.labels.max()) + 1

    @torch.no_grad()
    def remove_common_rigid(self, weights: Tensor | None = None) -> Tensor:
        """Remove the common rigid motion C from the control points and return it, (4, 4), float64, implant's frame.

        C is the rigid motion that best fits c -> c + phi_c. The control points become phi'_c = C^-1 (c + phi_c) - c,
        so that x + u(x) = C (x + u'(x)) exactly: B-splines reproduce rigid motions. (Beyond the grid this holds only
        if no group has all its CPs on a line, because the rigid motion of such a group is ambiguous.)

        Args:
            weights: Weight of each CP in the fit, shape (nx, ny, nz), such as the implant volume that it carries
                (`control_point_volumes`); equal if not given. The identity above holds for any weights.
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
        """Set the deformation to zero."""
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


def _with_grid(module: SplineField, state_dict: dict[str, Any], prefix: str, *_: Any) -> None:
    """Take state dicts without a grid, such as those of older checkpoints, as of the module's own."""
    state_dict.setdefault(f"{prefix}_extra_state", module.get_extra_state())

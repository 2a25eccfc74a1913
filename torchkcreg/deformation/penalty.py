"""Penalty on bending of a free-form deformation: diffusion penalty (eq. 5 of Cao et al. 2020) and the weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from torchkcreg.geometry import fit_rigid, invert_rigid, transform_points
from torchkcreg.splines.grid import ControlPointGrid


@dataclass(frozen=True)
class BendingPrior:
    """Weights of the penalties on a free-form deformation, in units of the loss.

    Attributes:
        beta: Weight of the diffusion penalty (eq. 5 of Cao et al. 2020), if groups move freely.
        stiffness: Weight of the implant's elastic energy (mean density over Young's modulus), if groups move freely.
        load_weight: Loss for a load of 1 kN along an elastic mode; it grows with the square of the load.
        youngs_modulus_gpa: Young's modulus of the implant, GPa.
    """

    beta: float = 1e-4
    stiffness: float = 30.0
    load_weight: float = 3e-9
    youngs_modulus_gpa: float = 200.0


def diffusion_penalty(control_points: Tensor, grid: ControlPointGrid, *, remove_rigid: bool = True) -> Tensor:
    """Diffusion penalty R of control-point displacements, mm^3, shape (...) (eq. 5 of Cao et al. 2020).

    R = sum ||grad phi||^2 dx dy dz / (nx ny nz), with forward differences in mm inside the grid (central
    differences would not penalise a checkerboard pattern). The best rigid motion is removed from phi first. Otherwise a
    rotation of the whole implant by one degree would cost about 1, whereas a difference of 1e-4 in gradient correlation
    decides 0.1 mm of depth.

    Args:
        control_points: Displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        grid: Control points.
        remove_rigid: If False, phi is used as it is.

    Raises:
        ValueError: If shapes do not fit.

    Example:
        >>> import torch
        >>> grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
        >>> stretch = 0.01 * grid.positions() * torch.tensor([1.0, 0.0, 0.0])
        >>> round(float(diffusion_penalty(stretch, grid)), 6)  # 0.01^2 over 3/4 of the CPs, 1000 mm^3 each
        0.075
    """
    if control_points.shape[-4:] != (*grid.shape, 3):
        raise ValueError(f"control_points must have shape (..., {grid.shape}, 3), got {tuple(control_points.shape)}")
    phi = without_rigid(control_points, grid) if remove_rigid else control_points
    squares = [(phi.diff(dim=axis - 4) / step).square().sum((-4, -3, -2, -1)) for axis, step in enumerate(grid.spacing)]
    return (squares[0] + squares[1] + squares[2]) * (math.prod(grid.spacing) / grid.num_control_points)


def without_rigid(control_points: Tensor, grid: ControlPointGrid) -> Tensor:
    """Displacements phi' (..., nx, ny, nz, 3) after removal of the best common rigid motion.

    phi'_c = C^-1 (c + phi_c) - c with C the least-squares fit of c -> c + phi_c over all control points.

    Args:
        control_points: Displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        grid: Control points.
    """
    positions = grid.positions().to(control_points).reshape(-1, 3)
    moved = positions + control_points.flatten(-4, -2)
    rest = transform_points(invert_rigid(fit_rigid(positions, moved)), moved) - positions
    return rest.reshape(control_points.shape)

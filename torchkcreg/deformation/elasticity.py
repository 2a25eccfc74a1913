"""Elastic energy of an implant that is deformed by groups of control points."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points
from torchkcreg.splines.grid import ControlPointGrid

from .deformation import combined
from .groups import group_moment_gradients, moment_features


def strain_energy(gradients: Tensor, volumes: Tensor, *, poisson: float = 0.0) -> Tensor:
    """Mean elastic energy density per unit of Young's modulus, shape (...), of a Saint Venant-Kirchhoff solid.

    `lambda / 2 tr(E)^2 + mu E : E` with the Green-Lagrange strain `E = (F^T F - I) / 2`. This strain is
    invariant under rigid motions of any size, so that large rotations of a plate's ends cost nothing beyond the bending
    itself. A plate of thickness h bent to curvature k has `(k h)^2 / 24`.

    Args:
        gradients: Deformation gradients F at the nodes, shape (..., N, 3, 3).
        volumes: Volumes of the nodes, shape (N,), mm^3.
        poisson: Poisson's ratio. Use zero for control points that move in rigid groups: these cannot contract
            laterally, and a positive ratio would make the implant appear too stiff.

    Raises:
        ValueError: If poisson is not from 0 up to, but not including, 0.5.

    Example:
        >>> stretch = torch.diag(torch.tensor([1.01, 1.0, 1.0]))
        >>> round(float(strain_energy(stretch[None], torch.ones(1))) * 1e6, 2)
        50.5
    """
    if not 0 <= poisson < 0.5:
        raise ValueError(f"poisson must be from 0 up to, but not including, 0.5, got {poisson}")
    strain = 0.5 * (gradients.mT @ gradients - torch.eye(3, dtype=gradients.dtype, device=gradients.device))
    first = poisson / ((1 + poisson) * (1 - 2 * poisson))
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    density = 0.5 * first * trace**2 + 0.5 / (1 + poisson) * strain.square().sum((-2, -1))
    return (density * (volumes / volumes.sum()).to(density)).sum(-1)


class Elasticity:
    """Strains and displacements of an implant under motions of groups of control points.

    Motions are given in the form of `motion_coefficients`, (K, 4 G, 3) in the grid's axes.

    Args:
        grid: Control points.
        labels: Group of each control point.
        points: Nodes of the implant, shape (N, 3). Bending is smooth, so a few thousand suffice for the integral.
        volumes: Their volumes, shape (N,), mm^3.
    """

    def __init__(self, grid: ControlPointGrid, labels: Tensor, points: Tensor, volumes: Tensor) -> None:
        points = points.double()
        self.volumes = volumes.double()
        self.moments = moment_features(grid, labels, points)
        self.slopes = group_moment_gradients(grid, labels, points).flatten(-2)
        self.grid, self.labels, self.points = grid, labels, points
        self.share = (self.volumes / self.volumes.sum()).sqrt()

    def of_filling(self) -> Elasticity:
        """The same for a solid that fills the grid's valid domain, with one node per cell."""
        cells = self.grid.positions()[1:-2, 1:-2, 1:-2].reshape(-1, 3)
        spacing = torch.tensor(self.grid.spacing, dtype=torch.float64, device=self.grid.frame.device)
        middles = transform_points(self.grid.frame, cells + spacing / 2)
        return Elasticity(self.grid, self.labels, middles, spacing.prod().expand(len(middles)))

    @property
    def volume(self) -> float:
        """Volume of the implant, mm^3."""
        return float(self.volumes.sum())

    def gradients(self, steps: Tensor) -> Tensor:
        """Deformation gradients (K, N, 3, 3)."""
        return torch.eye(3, dtype=steps.dtype, device=steps.device) + (self.slopes @ steps[:, None]).mT

    def energy(self, steps: Tensor) -> Tensor:
        """Mean energy density over Young's modulus, shape (K,): half the mean squared strain."""
        return strain_energy(self.gradients(steps), self.volumes)

    def stiffness(self, slopes: Tensor) -> Tensor:
        """Second derivatives (D, D) of the energy at rest along D directions, given as slopes (D, 4 G, 3).

        The squared strain `(H + H^T) / 2` of a small gradient H is `(H : H + H : H^T) / 2`, and H is linear in the 4 G
        coefficients. The sum over the nodes is therefore computed once, for products of coefficients.
        """
        weighted = self.slopes * self.share[:, None, None]  # (N, 3, 4 G): grid axis, coefficient
        products = torch.einsum("njf,nkg->jkfg", weighted, weighted)  # axes j and k, coefficients f and g
        same_axis = torch.einsum("jjfg->fg", products)
        first = torch.einsum("dfi,fg,egi->de", slopes, same_axis, slopes)
        second = torch.einsum("dfk,jkfg,egj->de", slopes, products, slopes)
        return 0.5 * (first + second)

    def displacements(self, steps: Tensor) -> Tensor:
        """Displacements (K, 3 N), mm, weighted so that their squares sum to the mean square displacement."""
        return (combined(self.moments, steps) * self.share[:, None]).flatten(1)

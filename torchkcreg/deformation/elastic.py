"""Linear elastic energy of an implant as a quadratic form of its control points."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation.basis import SplineBasis
from torchkcreg.deformation.grid import ControlPointGrid


def elastic_stiffness(grid: ControlPointGrid, points: Tensor, masses: Tensor, *, poisson: float = 0.3) -> Tensor:
    """Stiffness matrix K (3 C, 3 C), mm^3, float64, of an implant of unit Young's modulus, C = nx ny nz.

    The strain energy of displacements phi is 1/2 phi^T K phi, with phi flattened from (nx, ny, nz, 3) in the grid's
    axes; times Young's modulus in N/mm^2 it is in N mm. It is the integral over the implant, a sum over its nodes, of
    lambda/2 tr(eps)^2 + mu eps : eps with eps the symmetric gradient of the spline, lambda = nu / ((1+nu)(1-2nu)) and
    mu = 1 / (2 (1+nu)). Strains are small ones: take the common rigid motion out of phi first (`without_rigid`), for a
    finite rotation by t costs as much as a strain of t^2 / 2.

    A cloud of some 50 000 nodes gives the integral well enough.

    Args:
        grid: control points; the nodes must lie in its valid domain.
        points: nodes in the implant's frame, mm, shape (N, 3).
        masses: of the nodes, mm^3, shape (N,).
        poisson: Poisson's ratio nu, -1 < nu < 0.5.

    Raises:
        ValueError: if shapes do not fit, nodes lie outside the valid domain, or `poisson` is impossible.

    Example:
        >>> grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
        >>> k = elastic_stiffness(grid, torch.full((1, 3), 15.0), torch.tensor([2.0]), poisson=0.0)
        >>> stretch = 0.01 * grid.positions() * torch.tensor([1.0, 0.0, 0.0])
        >>> round(float(elastic_energy(stretch, k)), 9)  # strain^2 volume / 2
        0.0001
    """
    if masses.shape != points.shape[:1]:
        raise ValueError(f"masses must have shape ({len(points)},), got {tuple(masses.shape)}")
    if not -1 < poisson < 0.5:
        raise ValueError(f"poisson must lie between -1 and 0.5, got {poisson}")
    basis = SplineBasis(grid, points.detach(), torch.float64)
    if not grid.contains(points.detach().double()).all():
        raise ValueError("points must lie in the grid's valid domain, got some outside; use a larger grid")
    # S[ai, bj] = sum_n m_n dB_a/dx_i dB_b/dx_j holds all that the energy needs.
    spacing = torch.tensor(grid.spacing, dtype=torch.float64, device=points.device)
    size = grid.num_control_points
    products = basis.eta.new_zeros(3 * size, 3 * size)
    rows_of_cell = (3 * basis.control_points()[1][..., None] + torch.arange(3, device=points.device)).flatten(-2)
    for cell, nodes, slopes in basis.gradients():
        slopes = (slopes / spacing[:, None]).reshape(192, -1)
        block = (slopes * masses[nodes].double()) @ slopes.T
        owners = rows_of_cell[cell]
        products.index_put_((owners[:, None], owners), block, accumulate=True)
    products = products.reshape(size, 3, size, 3)
    lame, shear = poisson / ((1 + poisson) * (1 - 2 * poisson)), 0.5 / (1 + poisson)
    laplacian = products.diagonal(dim1=1, dim2=3).sum(-1)
    stiffness = lame * products + shear * products.transpose(1, 3)
    stiffness.diagonal(dim1=1, dim2=3).add_(shear * laplacian[..., None])
    return stiffness.reshape(3 * size, 3 * size)


def elastic_energy(control_points: Tensor, stiffness: Tensor) -> Tensor:
    """Strain energy 1/2 phi^T K phi per unit Young's modulus, mm^3, shape (...), see `elastic_stiffness`.

    Args:
        control_points: displacements phi in the grid's axes, mm, shape (..., nx, ny, nz, 3).
        stiffness: K, shape (3 C, 3 C).
    """
    phi = control_points.flatten(-4)
    if stiffness.shape != (phi.shape[-1], phi.shape[-1]):
        raise ValueError(f"stiffness must have shape ({phi.shape[-1]}, {phi.shape[-1]}), got {tuple(stiffness.shape)}")
    return 0.5 * ((phi @ stiffness.to(phi)) * phi).sum(-1)

"""The elastic energy of an implant whose groups of control points move, and its softest modes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchkcreg.deformation import ControlPointGrid, group_moment_gradients, group_moments, strain_energy
from torchkcreg.implant import ImplantPointCloud

from .motion import GroupMotion

_DIFFERENCE_MM = 1e-3
_FIT_ITERATIONS = 5


class Elasticity:
    """Strains and displacements of an implant under motions of groups of control points.

    Motions are given as ``GroupMotion.steps`` gives them, (K, 4 G, 3) in the grid's axes.

    Args:
        grid: Control points.
        labels: Group of each control point.
        cloud: Nodes of the implant; bending is smooth, a few thousand give its integral.
    """

    def __init__(self, grid: ControlPointGrid, labels: Tensor, cloud: ImplantPointCloud) -> None:
        points = cloud.points.double()
        shares, moments = group_moments(grid, labels, points)
        self.volumes = cloud.masses.double()
        self.moments = torch.cat([shares[..., None], moments], dim=-1).flatten(1)
        self.slopes = group_moment_gradients(grid, labels, points).flatten(-2)
        self.points = cloud.points
        self.share = (self.volumes / self.volumes.sum()).sqrt()

    @property
    def volume(self) -> float:
        """Of the implant, mm^3."""
        return float(self.volumes.sum())

    def gradients(self, steps: Tensor) -> Tensor:
        """Deformation gradients (K, N, 3, 3)."""
        return torch.eye(3).to(steps) + (self.slopes @ steps[:, None]).mT

    def energy(self, steps: Tensor) -> Tensor:
        """Mean energy density over Young's modulus, shape (K,); half a squared strain."""
        return strain_energy(self.gradients(steps), self.volumes)

    def strains(self, steps: Tensor) -> Tensor:
        """Green-Lagrange strains, (K, 9 N), so weighted that half their squares sum to the energy."""
        gradients = self.gradients(steps)
        strain = 0.5 * (gradients.mT @ gradients - torch.eye(3).to(steps))
        return (strain * self.share[:, None, None]).flatten(1)

    def displacements(self, steps: Tensor) -> Tensor:
        """Displacements, (K, 3 N), so weighted that their squares sum to the mean square, mm^2."""
        return ((self.moments @ steps) * self.share[:, None]).flatten(1)


class ModalMotion:
    """Motions of groups along an implant's softest elastic modes.

    Modes solve ``K p = k M p`` with K the second derivatives of the elastic energy over the groups' parameters and M
    those of the mean square displacement. The first six are rigid (k = 0), then come the implant's bends and twists
    in the order of their stiffness, whatever its shape. What an implant would resist is thus left out, and what is
    left is smooth where splitting into ever more rigid groups leaves kinks. Parameters are increments to what the modes
    can follow of the displacement so far.

    Args:
        groups: The groups' motions from the undeformed implant.
        elasticity: Of the implant under these groups.
        num_modes: How many modes are kept, rigid ones included.
        displacement: Of the elasticity's points so far, in the grid's axes, shape (N, 3), mm.

    Attributes:
        start: (m,): what the modes follow of the displacement so far.
        modes: (P, m): groups' parameters of a mode whose root mean square displacement is 1 mm.
        stiffnesses: (m,): second derivative of the energy (the integral of its density over Young's modulus) along
            each mode, mm.
    """

    def __init__(self, groups: GroupMotion, elasticity: Elasticity, num_modes: int, displacement: Tensor) -> None:
        self.groups = groups
        size = groups.num_parameters
        strains = _derivatives(lambda p: elasticity.strains(groups.steps(p)), size)
        moves = _derivatives(lambda p: elasticity.displacements(groups.steps(p)), size)
        values, self.modes = _generalized_eigenvectors(strains @ strains.T, moves @ moves.T, min(num_modes, size))
        self.stiffnesses = elasticity.volume * values.clamp_min(0.0)
        self.start = torch.zeros(self.modes.shape[1], dtype=torch.float64)
        wanted = (displacement.double() * elasticity.share[:, None]).flatten()
        for _ in range(_FIT_ITERATIONS):  # Gauss-Newton: finite rotations are not quite linear
            missing = wanted - elasticity.displacements(self.steps(torch.zeros_like(self.start)[None]))[0]
            self.start = self.start + self.modes.T @ (moves @ missing)

    @property
    def num_parameters(self) -> int:
        """One a mode."""
        return self.modes.shape[1]

    def __call__(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, G, 3, 3) and translations (K, G, 3) of the groups.

        Args:
            parameters: Shape (K, m), mm of root mean square displacement.
        """
        return self.groups(self._of_groups(parameters))

    def steps(self, parameters: Tensor) -> Tensor:
        """See `GroupMotion.steps`."""
        return self.groups.steps(self._of_groups(parameters))

    def loads(self, parameters: Tensor) -> Tensor:
        """Loads (K, m) along the modes that hold the implant in its shape, over Young's modulus, mm^2."""
        return self.stiffnesses * (self.start + parameters)

    def _of_groups(self, parameters: Tensor) -> Tensor:
        return (self.start + parameters) @ self.modes.T


def _derivatives(function: Callable[[Tensor], Tensor], size: int) -> Tensor:
    """Derivatives (P, S) of a function of P parameters at zero."""
    offsets = _DIFFERENCE_MM * torch.eye(size, dtype=torch.float64)
    return (function(offsets) - function(-offsets)) / (2 * _DIFFERENCE_MM)


def _generalized_eigenvectors(stiffness: Tensor, inertia: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """The smallest eigenvalues (m,) and vectors (P, m), of inertia one, of a symmetric pencil."""
    tiny = 1e-8 * inertia.diagonal().mean()  # groups that carry hardly any of the implant
    lower = torch.linalg.cholesky(inertia + tiny * torch.eye(len(inertia)).to(inertia))
    half = torch.linalg.solve_triangular(lower, stiffness, upper=False)
    reduced = torch.linalg.solve_triangular(lower, half.T, upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (reduced + reduced.T))
    return values[:number], torch.linalg.solve_triangular(lower.T, vectors[:, :number], upper=True)

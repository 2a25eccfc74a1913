"""The elastic energy of an implant whose groups of control points move, and its softest modes."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation import ControlPointGrid, group_moment_gradients, group_moments, strain_energy
from torchkcreg.geometry import transform_points

from .motion import GroupMotion

_DIFFERENCE_MM = 1e-3
_FIT_ITERATIONS = 5
# The control points are joined by a matter much softer than metal, and lighter still. It tells groups that hold no
# metal to follow those that do, and its own vibrations are far from the implant's softest.
_FILLING_STIFFNESS = 1e-6
_FILLING_DENSITY = 1e-9


class Elasticity:
    """Strains and displacements of an implant under motions of groups of control points.

    Motions are given as ``GroupMotion.steps`` gives them, (K, 4 G, 3) in the grid's axes.

    Args:
        grid: Control points.
        labels: Group of each control point.
        points: Nodes of the implant, shape (N, 3); bending is smooth, a few thousand give its integral.
        masses: Their volumes, shape (N,), mm^3.
    """

    def __init__(self, grid: ControlPointGrid, labels: Tensor, points: Tensor, masses: Tensor) -> None:
        points = points.double()
        shares, moments = group_moments(grid, labels, points)
        self.volumes = masses.double()
        self.moments = torch.cat([shares[..., None], moments], dim=-1).flatten(1)
        self.slopes = group_moment_gradients(grid, labels, points).flatten(-2)
        self.grid, self.labels, self.points = grid, labels, points
        self.share = (self.volumes / self.volumes.sum()).sqrt()

    def of_filling(self) -> Elasticity:
        """The same for a solid that fills the grid's valid domain, one node a cell."""
        cells = self.grid.positions()[1:-2, 1:-2, 1:-2].reshape(-1, 3)
        spacing = torch.tensor(self.grid.spacing, dtype=torch.float64)
        middles = transform_points(self.grid.frame, cells + spacing / 2)
        return Elasticity(self.grid, self.labels, middles, spacing.prod().expand(len(middles)))

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
    those of the mean square displacement, both with a trace of a soft matter between the control points: groups that
    hold hardly any metal would leave the pencil without a definite solution. The first six are rigid (k = 0), then come
    the implant's bends and twists in the order of their stiffness, whatever its shape. What an implant would resist is
    thus left out, and what is left is smooth where splitting into ever more rigid groups leaves kinks. Parameters are
    increments to what the modes can follow of the displacement so far.

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
        misfit_mm: Root mean square of what the modes cannot follow of the displacement so far.
    """

    def __init__(self, groups: GroupMotion, elasticity: Elasticity, num_modes: int, displacement: Tensor) -> None:
        self.groups = groups
        moves, inertia, stiffness = _derivatives(groups, elasticity)
        filling = elasticity.of_filling()
        _, light, soft = _derivatives(groups, filling)
        share = filling.volume / elasticity.volume
        inertia, stiffness = inertia + _FILLING_DENSITY * share * light, stiffness + _FILLING_STIFFNESS * share * soft
        number = min(num_modes, groups.num_parameters)
        values, self.modes = _generalized_eigenvectors(stiffness, inertia, number)
        self.stiffnesses = elasticity.volume * values.clamp_min(0.0)
        self.start = torch.zeros(self.modes.shape[1], dtype=torch.float64)
        wanted = (displacement.double() * elasticity.share[:, None]).flatten()
        along = self.modes.T @ moves
        fits = []
        for _ in range(_FIT_ITERATIONS):  # Gauss-Newton: finite rotations are not quite linear
            missing = wanted - elasticity.displacements(self.steps(torch.zeros_like(self.start)[None]))[0]
            fits.append((float(missing.detach().norm()), self.start))
            self.start = self.start + torch.linalg.solve(along @ along.T, along @ missing)
        self.misfit_mm, self.start = min(fits, key=lambda fit: fit[0])

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


def _derivatives(groups: GroupMotion, elasticity: Elasticity) -> tuple[Tensor, Tensor, Tensor]:
    """At rest: those (P, S) of the displacements, and the second ones (P, P) of their mean square and of the energy."""
    offsets = _DIFFERENCE_MM * torch.eye(groups.num_parameters, dtype=torch.float64)
    ahead, behind = groups.steps(offsets), groups.steps(-offsets)
    moves = (elasticity.displacements(ahead) - elasticity.displacements(behind)) / (2 * _DIFFERENCE_MM)
    strains = (elasticity.strains(ahead) - elasticity.strains(behind)) / (2 * _DIFFERENCE_MM)
    return moves, moves @ moves.T, strains @ strains.T


def _generalized_eigenvectors(stiffness: Tensor, inertia: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """The smallest eigenvalues (m,) and vectors (P, m), of inertia one, of a symmetric pencil."""
    lower = torch.linalg.cholesky(inertia)
    half = torch.linalg.solve_triangular(lower, stiffness, upper=False)
    reduced = torch.linalg.solve_triangular(lower, half.T, upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (reduced + reduced.T))
    return values[:number], torch.linalg.solve_triangular(lower.T, vectors[:, :number], upper=True)

"""Motions along an implant's softest elastic modes."""

from __future__ import annotations

import torch
from torch import Tensor

from .deformation import Motion
from .elasticity import Elasticity
from .group_motion import GroupMotion

_DIFFERENCE_MM = 1e-3
_FIT_ITERATIONS = 5
# The control points are joined by a matter much softer than metal, and lighter still. It tells groups that hold no
# metal to follow those that do, and its own vibrations are far from the implant's softest.
_FILLING_STIFFNESS = 1e-6
_FILLING_DENSITY = 1e-9


class ModalMotion(Motion):
    """Motions of groups along an implant's softest elastic modes.

    Modes solve ``K p = k M p`` with K the second derivatives of the elastic energy over the groups' parameters and M
    those of the mean square displacement, both with a trace of a soft matter between the control points: groups that
    hold hardly any metal would leave the pencil without a definite solution. The first six are rigid (k = 0), then come
    the implant's bends and twists in the order of their stiffness, whatever its shape. What an implant would resist is
    thus left out, and what is left is smooth where splitting into ever more rigid groups leaves kinks. Parameters are
    increments to what the modes can follow of the displacement so far.

    Args:
        groups: The groups' motions from the undeformed implant.
        num_modes: How many modes are kept, rigid ones included.
        displacement: Of the points of the groups' elasticity so far, in the implant's frame, shape (N, 3), mm.

    Attributes:
        start: (m,): what the modes follow of the displacement so far.
        modes: (P, m): groups' parameters of a mode whose root mean square displacement is 1 mm.
        stiffnesses: (m,): second derivative of the energy (the integral of its density over Young's modulus) along
            each mode, mm.
        misfit_mm: Root mean square of what the modes cannot follow of the displacement so far.
    """

    def __init__(self, groups: GroupMotion, num_modes: int, displacement: Tensor) -> None:
        self.groups, elasticity = groups, groups.elasticity
        moves, inertia, stiffness = _derivatives(groups, elasticity)
        filling = elasticity.of_filling()
        _, light, soft = _derivatives(groups, filling)
        share = filling.volume / elasticity.volume
        inertia, stiffness = inertia + _FILLING_DENSITY * share * light, stiffness + _FILLING_STIFFNESS * share * soft
        number = min(num_modes, groups.num_parameters)
        values, self.modes = _generalized_eigenvectors(stiffness, inertia, number)
        self.stiffnesses = elasticity.volume * values.clamp_min(0.0)
        self.start = self.modes.new_zeros(self.modes.shape[1])
        in_grid = displacement.double() @ groups.grid.frame[:3, :3].to(displacement.device)
        wanted = (in_grid * elasticity.share[:, None]).flatten()
        along = self.modes.T @ moves
        fits = []
        for _ in range(_FIT_ITERATIONS):  # Gauss-Newton: finite rotations are not quite linear
            here = groups.in_grid(self._of_groups(torch.zeros_like(self.start)[None]))
            missing = wanted - elasticity.displacements(here)[0]
            fits.append((float(missing.detach().norm()), self.start))
            self.start = self.start + torch.linalg.solve(along @ along.T, along @ missing)
        self.misfit_mm, self.start = min(fits, key=lambda fit: fit[0])

    @property
    def num_parameters(self) -> int:  # type: ignore[override]
        """One a mode, mm of root mean square displacement."""
        return self.modes.shape[1]

    def features(self, points: Tensor) -> Tensor:
        """See `GroupMotion.features`."""
        return self.groups.features(points)

    def coefficients(self, steps: Tensor) -> Tensor:
        """See `GroupMotion.coefficients`."""
        return self.groups.coefficients(self._of_groups(steps))

    def accept(self, steps: Tensor) -> Tensor:
        """See `GroupMotion.accept`."""
        return self.groups.accept(self._of_groups(steps[None])[0])

    def penalty(self, steps: Tensor) -> Tensor:
        """The weighted sum of squared loads that hold the implant in its shape.

        Loads do not charge a bend for being strong, as the energy does, but for needing forces in many places: between
        the screws that load it a plate is free.
        """
        prior = self.groups.prior
        return prior.load_weight * (prior.youngs_modulus_gpa * self.loads(steps)).square().sum(-1)

    def loads(self, steps: Tensor) -> Tensor:
        """Loads (K, m) along the modes that hold the implant in its shape, over Young's modulus, mm^2."""
        return self.stiffnesses * (self.start + steps)

    def _of_groups(self, steps: Tensor) -> Tensor:
        return (self.start + steps) @ self.modes.T


def _derivatives(groups: GroupMotion, elasticity: Elasticity) -> tuple[Tensor, Tensor, Tensor]:
    """At rest: those (P, S) of the displacements, and the second ones (P, P) of their mean square and of the energy."""
    offsets = _DIFFERENCE_MM * torch.eye(groups.num_parameters, dtype=torch.float64, device=groups.centers.device)
    slopes = (groups.in_grid(offsets) - groups.in_grid(-offsets)) / (2 * _DIFFERENCE_MM)
    moves = elasticity.displacements(slopes)
    return moves, moves @ moves.T, elasticity.stiffness(slopes)


def _generalized_eigenvectors(stiffness: Tensor, inertia: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """The smallest eigenvalues (m,) and vectors (P, m), of inertia one, of a symmetric pencil."""
    lower = torch.linalg.cholesky(inertia)
    half = torch.linalg.solve_triangular(lower, stiffness, upper=False)
    reduced = torch.linalg.solve_triangular(lower, half.T, upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (reduced + reduced.T))
    return values[:number], torch.linalg.solve_triangular(lower.T, vectors[:, :number], upper=True)

"""Motions along an implant's softest elastic modes."""

from __future__ import annotations

import torch
from torch import Tensor

from .deformation import Motion
from .elasticity import Elasticity
from .group_motion import GroupMotion

_DIFFERENCE_MM = 1e-3
_FIT_ITERATIONS = 5
# The grid is filled with a material much softer than metal and lighter still. Groups that hold no metal then follow
# those that do, and the vibrations of the filling lie far above the implant's softest modes.
_FILLING_STIFFNESS = 1e-6
_FILLING_DENSITY = 1e-9


class ModalMotion(Motion):
    """Motions of groups along an implant's softest elastic modes.

    Modes solve `K p = k M p`, where K holds the second derivatives of the elastic energy with respect to the groups'
    parameters and M those of the mean square displacement. Both include a small contribution of a soft filling between
    the control points; without it, groups that hold hardly any metal would make the problem singular. The first six
    modes are rigid (k = 0). The implant's bending and twisting modes follow, ordered by stiffness, whatever its shape.
    Deformations that the implant would resist are thus left out, and the remaining ones are smooth, unlike those of
    many rigid groups, which have kinks. Parameters are increments to the modes' fit of the current displacement.

    Args:
        groups: Motions of the groups, starting from the undeformed implant.
        num_modes: Number of modes, rigid ones included.
        displacement: Current displacement of the points of `groups.elasticity`, in the implant's frame, (N, 3), mm.

    Attributes:
        start: Amounts (m,) of the modes that fit the current displacement.
        modes: Group parameters (P, m) of each mode, scaled to a root mean square displacement of 1 mm.
        stiffnesses: Second derivative (m,) of the energy (the integral of its density over Young's modulus) along
            each mode, mm.
        misfit_mm: Root mean square residual of that fit.
    """

    def __init__(self, groups: GroupMotion, num_modes: int, displacement: Tensor) -> None:
        self.groups, elasticity = groups, groups.elasticity
        moves, inertia, stiffness = _derivatives(groups, elasticity)
        filling = elasticity.of_filling()
        _, filling_inertia, filling_stiffness = _derivatives(groups, filling)
        volume_ratio = filling.volume / elasticity.volume
        inertia, stiffness = (
            inertia + _FILLING_DENSITY * volume_ratio * filling_inertia,
            stiffness + _FILLING_STIFFNESS * volume_ratio * filling_stiffness,
        )
        num_kept = min(num_modes, groups.num_parameters)
        values, self.modes = _generalized_eigenvectors(stiffness, inertia, num_kept)
        self.stiffnesses = elasticity.volume * values.clamp_min(0.0)
        self.start = self.modes.new_zeros(self.modes.shape[1])
        in_grid = displacement.double() @ groups.grid.frame[:3, :3].to(displacement.device)
        target = (in_grid * elasticity.share[:, None]).flatten()
        along = self.modes.T @ moves
        fits = []
        for _ in range(_FIT_ITERATIONS):  # Gauss-Newton: finite rotations are not quite linear
            coefficients = groups.in_grid(self._of_groups(torch.zeros_like(self.start)[None]))
            residual = target - elasticity.displacements(coefficients)[0]
            fits.append((float(residual.detach().norm()), self.start))
            self.start = self.start + torch.linalg.solve(along @ along.T, along @ residual)
        self.misfit_mm, self.start = min(fits, key=lambda fit: fit[0])

    @property
    def num_parameters(self) -> int:  # type: ignore[override]
        """One per mode, in mm of root mean square displacement."""
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
        """Weighted sum of squared loads that hold the implant in its shape, (K,).

        Unlike the energy, the loads do not penalise strong bending as such, but bending that needs forces in many
        places: between the screws that load it, a plate is free.
        """
        prior = self.groups.prior
        return prior.load_weight * (prior.youngs_modulus_gpa * self.loads(steps)).square().sum(-1)

    def loads(self, steps: Tensor) -> Tensor:
        """Loads (K, m) along the modes that hold the implant in its shape, divided by Young's modulus, mm^2."""
        return self.stiffnesses * (self.start + steps)

    def _of_groups(self, steps: Tensor) -> Tensor:
        return (self.start + steps) @ self.modes.T


def _derivatives(groups: GroupMotion, elasticity: Elasticity) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives at rest with respect to the P parameters: of the displacements (P, S), and second ones (P, P).

    The second derivatives are those of the mean square displacement and of the energy.
    """
    offsets = _DIFFERENCE_MM * torch.eye(groups.num_parameters, dtype=torch.float64, device=groups.centers.device)
    slopes = (groups.in_grid(offsets) - groups.in_grid(-offsets)) / (2 * _DIFFERENCE_MM)
    displacements = elasticity.displacements(slopes)
    return displacements, displacements @ displacements.T, elasticity.stiffness(slopes)


def _generalized_eigenvectors(stiffness: Tensor, inertia: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """Smallest eigenvalues (m,) and eigenvectors (P, m), scaled to unit inertia, of a symmetric pencil."""
    lower = torch.linalg.cholesky(inertia)
    half = torch.linalg.solve_triangular(lower, stiffness, upper=False)
    reduced = torch.linalg.solve_triangular(lower, half.T, upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (reduced + reduced.T))
    return values[:number], torch.linalg.solve_triangular(lower.T, vectors[:, :number], upper=True)

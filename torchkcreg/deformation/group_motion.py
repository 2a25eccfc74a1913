"""Rigid motions of control-point groups, parametrised in millimetres for an optimiser."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, rotation_from_vector
from torchkcreg.implant import ImplantPointCloud

from .deformation import Motion
from .elasticity import Elasticity
from .groups import (
    carrying,
    cluster_control_points,
    control_point_volumes,
    control_points_from_groups,
    group_centers,
    moment_features,
    motion_coefficients,
)
from .penalty import BendingPrior, diffusion_penalty
from .spline_field import SplineField

_CARRIED_PITCH_MM = 1.0
_SOLID_PITCH_MM = 2.0  # bending is smooth, so few nodes suffice for its energy
_LEAST_RADIUS_MM = 5.0


class GroupMotion(Motion):
    """Increments to the rigid motions of G groups, in mm: per group three rotations times a radius, three translations.

    A zero vector leaves the control points where they are. Rotations are about the group's centre and are scaled
    by its radius of gyration, so that a unit step in any parameter moves the implant by at most about 1 mm.

    Args:
        field: Control points with their current displacements.
        cloud: The implant. The implant volume that each control point carries decides how they are grouped.
        num_groups: Number of groups G. If fewer control points carry any of the implant, there are fewer groups.
        prior: Weights of the penalties on bending.
        from_rest: Start from the undeformed implant instead of the current control points.
    """

    def __init__(
        self,
        field: SplineField,
        cloud: ImplantPointCloud,
        num_groups: int,
        prior: BendingPrior,
        *,
        from_rest: bool = False,
    ) -> None:
        self.field, self.grid, self.prior = field, field.grid, prior
        coarse, solid = cloud.coarsened_to(_CARRIED_PITCH_MM), cloud.coarsened_to(_SOLID_PITCH_MM)
        self.weights = control_point_volumes(self.grid, coarse.points, coarse.volumes)
        num_carrying = int(carrying(self.weights).sum())
        self.labels = cluster_control_points(self.grid, self.weights, min(num_groups, num_carrying))
        self.elasticity = Elasticity(self.grid, self.labels, solid.points, solid.volumes)
        self.centers = group_centers(self.grid, self.labels)
        displacements = field.control_points.detach().double().reshape(-1, 3)
        self._start_from(torch.zeros_like(displacements) if from_rest else displacements)

    def _start_from(self, displacements: Tensor) -> None:
        """Set motions, pivots and radii of the groups from control-point displacements (C, 3)."""
        positions = self.grid.positions().double().reshape(-1, 3)
        weights = self.weights.flatten().double() + 1e-6 * self.weights.double().mean()
        rotations, translations, pivots, radii = [], [], [], []
        for group, center in enumerate(self.centers):
            members = self.labels.flatten() == group
            points, volumes = positions[members], weights[members]
            motion = fit_rigid(points, points + displacements[members])
            pivot = (volumes[:, None] * points).sum(0) / volumes.sum()
            radii.append(((volumes[:, None] * (points - pivot) ** 2).sum() / volumes.sum()).sqrt())
            rotations.append(motion[:3, :3])
            translations.append(motion[:3, :3] @ center + motion[:3, 3] - center)
            pivots.append(motion[:3, :3] @ pivot + motion[:3, 3])
        self.rotations, self.translations = torch.stack(rotations), torch.stack(translations)
        self.pivots, self.radii = torch.stack(pivots), torch.stack(radii).clamp_min(_LEAST_RADIUS_MM)

    @property
    def num_parameters(self) -> int:  # type: ignore[override]
        """Six per group."""
        return 6 * len(self.centers)

    def group_motions(self, steps: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, G, 3, 3) and translations (K, G, 3) of the groups about their centres, R_g and t_g.

        Args:
            steps: Shape (K, 6 G), mm.
        """
        steps = steps.unflatten(-1, (-1, 6))
        turn = rotation_from_vector(steps[..., :3] / self.radii[:, None].to(steps))
        pivots, centers = self.pivots.to(steps), self.centers.to(steps)
        rotations = turn @ self.rotations.to(steps)
        start = centers + self.translations.to(steps) - pivots
        moved = (turn @ start[..., None])[..., 0] + pivots + steps[..., 3:]
        return rotations, moved - centers

    def in_grid(self, steps: Tensor) -> Tensor:
        """Motions (K, 4 G, 3) of the groups in the grid's axes, see `motion_coefficients`."""
        return motion_coefficients(*self.group_motions(steps))

    def features(self, points: Tensor) -> Tensor:
        """Moments (N, 4 G) of the B-spline weights, see `moment_features`."""
        return moment_features(self.grid, self.labels, points)

    def coefficients(self, steps: Tensor) -> Tensor:
        """Translations and rotations of the groups in the implant's axes, (K, 4 G, 3)."""
        return self.grid.to_implant(self.in_grid(steps))

    def control_points(self, steps: Tensor) -> Tensor:
        """Control-point displacements (K, nx, ny, nz, 3)."""
        return control_points_from_groups(self.grid, self.labels, *self.group_motions(steps))

    def penalty(self, steps: Tensor) -> Tensor:
        """Sum of beta R (eq. 5) and the weighted elastic energy, shape (K,)."""
        diffusion = diffusion_penalty(self.control_points(steps), self.grid)
        return self.prior.beta * diffusion + self.prior.stiffness * self.elasticity.energy(self.in_grid(steps))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """Store the control points without their best common rigid motion, and return that motion (4, 4)."""
        self.field.control_points.copy_(self.control_points(steps[None])[0])
        self.field.labels.copy_(self.labels)
        return self.field.remove_common_rigid(self.weights)

"""Rigid motions of control-point groups as a vector of millimetres that an optimiser can walk in."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, rotation_from_vector


class GroupMotion:
    """Increments to the rigid motions of G groups, all in mm: three rotations times a radius, three translations.

    A zero vector leaves the control points where they are. Rotations turn about the group's own centre and are scaled
    by its radius of gyration, so that a unit step in any parameter moves the implant by at most about 1 mm.

    Args:
        positions: Control points in the grid's frame, shape (C, 3), mm.
        displacements: Their displacements so far, shape (C, 3), mm.
        labels: Group of each control point, shape (C,).
        weights: Implant volume that each control point carries, shape (C,).
        centers: Centres about which the moments of the groups are taken, shape (G, 3), mm.
    """

    def __init__(
        self, positions: Tensor, displacements: Tensor, labels: Tensor, weights: Tensor, centers: Tensor
    ) -> None:
        self.centers = centers.double()
        rotations, translations, pivots, radii = [], [], [], []
        for group, center in enumerate(self.centers):
            members = labels == group
            here, moved = positions[members].double(), (positions + displacements)[members].double()
            motion = fit_rigid(here, moved)
            weight = weights[members].double() + 1e-6 * weights.double().mean()
            pivot = (weight[:, None] * here).sum(0) / weight.sum()
            radius = ((weight[:, None] * (here - pivot) ** 2).sum() / weight.sum()).sqrt()
            rotations.append(motion[:3, :3])
            translations.append(motion[:3, :3] @ center + motion[:3, 3] - center)
            pivots.append(motion[:3, :3] @ pivot + motion[:3, 3])
            radii.append(radius)
        self.rotations, self.translations = torch.stack(rotations), torch.stack(translations)
        self.pivots, self.radii = torch.stack(pivots), torch.stack(radii).clamp_min(5.0)

    @property
    def num_parameters(self) -> int:
        """Six a group."""
        return 6 * len(self.centers)

    def __call__(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, G, 3, 3) and translations (K, G, 3) of the groups about their centres, R_g and t_g.

        Args:
            parameters: Shape (K, 6 G), mm.
        """
        steps = parameters.reshape(*parameters.shape[:-1], -1, 6)
        turn = rotation_from_vector(steps[..., :3] / self.radii[:, None].to(steps))
        pivots, centers = self.pivots.to(steps), self.centers.to(steps)
        rotations = turn @ self.rotations.to(steps)
        start = centers + self.translations.to(steps) - pivots
        moved = (turn @ start[..., None])[..., 0] + pivots + steps[..., 3:]
        return rotations, moved - centers

    def steps(self, parameters: Tensor) -> Tensor:
        """Motions (K, 4 G, 3) of the groups as the nodes' moments multiply them: t_g, then R_g - I.

        Args:
            parameters: Shape (K, 6 G), mm.
        """
        rotations, translations = self(parameters)
        turns = (rotations - torch.eye(3).to(rotations)).mT
        return torch.cat([translations[..., None, :], turns], dim=-2).flatten(1, 2)

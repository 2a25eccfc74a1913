"""Motion of an implant as a whole, whatever its deformation."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation.model import Deformation, Motion
from torchkcreg.geometry import rigid_matrix, rotation_from_vector
from torchkcreg.implant import ImplantPointCloud


class RigidMotion(Motion):
    """Three rotations about an implant's middle, times its radius of gyration, and three translations, all in mm.

    Args:
        deformation: How the implant is bent; it stays so.
        cloud: The implant.
    """

    num_parameters = 6

    def __init__(self, deformation: Deformation, cloud: ImplantPointCloud) -> None:
        self.deformation = deformation
        coarse = cloud.coarsened_to(1.0)
        points, share = coarse.points.double(), (coarse.volumes / coarse.volumes.sum()).double()[:, None]
        self.center = (share * points).sum(0)
        self.radius = (share * (points - self.center) ** 2).sum().sqrt()

    def features(self, points: Tensor) -> Tensor:
        """1, x + u(x) - c, u(x)."""
        points = points.double()
        with torch.no_grad():
            moved = self.deformation.displacement(points)
        return torch.cat([torch.ones_like(points[..., :1]), points + moved - self.center, moved], dim=-1)

    def coefficients(self, steps: Tensor) -> Tensor:
        """t, R - I, I."""
        turn, shift = self.turn_and_shift(steps)
        same = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return torch.cat([shift[:, None], turn.mT - same, same], dim=1)

    def turn_and_shift(self, steps: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, 3, 3) about the middle, and shifts (K, 3) of it."""
        return rotation_from_vector(steps[:, :3] / self.radius), steps[:, 3:6]

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """The rotation and translation."""
        turn, shift = self.turn_and_shift(steps[None].double())
        motion = rigid_matrix(torch.zeros_like(self.center), self.center + shift[0] - turn[0] @ self.center)
        motion[:3, :3] = turn[0]
        return motion

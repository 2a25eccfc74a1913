"""Rigid deformations, and deformations that are linear in a few amounts, with their motions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.geometry import rigid_matrix, rotation_from_vector
from torchkcreg.implant import ImplantPointCloud

from .deformation import Deformation, Level, Motion


class RigidMotion(Motion):
    """Three rotations about an implant's centre of mass, times its radius of gyration, and three translations, in mm.

    Args:
        deformation: Deformation of the implant; it stays unchanged.
        cloud: The implant.
    """

    num_parameters = 6

    def __init__(self, deformation: Deformation, cloud: ImplantPointCloud) -> None:
        self.deformation = deformation
        self.center, self.radius = cloud.gyration()

    def features(self, points: Tensor) -> Tensor:
        """Features 1, x + u(x) - c, u(x)."""
        points = points.double()
        with torch.no_grad():
            moved = self.deformation.displacement(points)
        return torch.cat([torch.ones_like(points[..., :1]), points + moved - self.center, moved], dim=-1)

    def coefficients(self, steps: Tensor) -> Tensor:
        """Coefficients t, R - I, I."""
        turn, shift = self.turn_and_shift(steps)
        identity = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return torch.cat([shift[:, None], turn.mT - identity, identity], dim=1)

    def turn_and_shift(self, steps: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, 3, 3) about the centre of mass, and shifts (K, 3) of it."""
        return rotation_from_vector(steps[:, :3] / self.radius), steps[:, 3:6]

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """Rigid motion (4, 4) of the steps."""
        turn, shift = self.turn_and_shift(steps[None].double())
        motion = rigid_matrix(torch.zeros_like(self.center), self.center + shift[0] - turn[0] @ self.center)
        motion[:3, :3] = turn[0]
        return motion


class LinearDeformation(Deformation):
    """Displacements `u(x) = sum_m q_m shape_m(x)`. Subclasses override `shapes` and, if needed, `prior`.

    Args:
        num_amounts: Number of shapes M. An amount of one should move the implant by about 1 mm.

    Attributes:
        amounts: Parameter q (M,), float64.

    >>> class Bow(LinearDeformation):
    ...     def shapes(self, points):
    ...         x, y, z = points.unbind(-1)
    ...         return torch.stack([0 * x, (z / 50) ** 2, 0 * x], dim=-1)[..., None, :]
    >>> bow = Bow(1)
    >>> bow.amounts.data.fill_(2.0)
    tensor([2.], dtype=torch.float64)
    >>> bow.displacement(torch.tensor([[0.0, 0.0, 50.0]])).tolist()
    [[0.0, 2.0, 0.0]]
    """

    model = "linear"

    def __init__(self, num_amounts: int) -> None:
        super().__init__()
        self.amounts = nn.Parameter(torch.zeros(num_amounts, dtype=torch.float64, device="cpu"))

    def shapes(self, points: Tensor) -> Tensor:
        """Displacements (..., N, M, 3) of points (..., N, 3) for an amount of one of each shape, mm."""
        raise NotImplementedError

    def prior(self, amounts: Tensor) -> Tensor:
        """Prior of amounts (K, M), shape (K,), in units of the loss; zero by default."""
        return amounts.new_zeros(amounts.shape[:-1])

    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame."""
        shapes = self.shapes(points)
        return torch.einsum("...mi,m->...i", shapes, self.amounts.to(shapes)).to(points)

    def motion(self, cloud: ImplantPointCloud, level: Level) -> LinearMotion:
        """Three rotations, three translations and, unless the level is rigid, the amounts."""
        return LinearMotion(self, cloud, free=not level.is_rigid)


class RigidDeformation(LinearDeformation):
    """No deformation: the implant moves as a whole."""

    model = "rigid"

    def __init__(self) -> None:
        super().__init__(0)

    def shapes(self, points: Tensor) -> Tensor:
        """No shapes, (..., N, 0, 3)."""
        return points.new_zeros(*points.shape[:-1], 0, 3)

    def to_dict(self) -> dict[str, Any]:
        """The model's name only."""
        return {"model": self.model}


class LinearMotion(RigidMotion):
    """Rotation and translation of the whole implant, in mm, and changes of a linear deformation's amounts.

    `x + u(x)` becomes `R (x + sum_m q_m shape_m(x) - c) + c + t`: the shapes turn with the implant.

    Args:
        deformation: Deformation from which the motion starts.
        cloud: The implant. Its centre of mass is c, and its radius of gyration converts angles to millimetres.
        free: If False, the amounts stay fixed.
    """

    def __init__(self, deformation: LinearDeformation, cloud: ImplantPointCloud, *, free: bool) -> None:
        super().__init__(deformation, cloud)
        self.linear, self.free = deformation, free
        self.start = deformation.amounts.detach().clone()
        self.num_parameters = 6 + (len(self.start) if free else 0)

    def features(self, points: Tensor) -> Tensor:
        """Features 1, x - c, then the three components of each shape."""
        points = points.double()
        with torch.no_grad():
            shapes = self.linear.shapes(points).flatten(-2)
        return torch.cat([torch.ones_like(points[..., :1]), points - self.center, shapes], dim=-1)

    def coefficients(self, steps: Tensor) -> Tensor:
        """Coefficients t, then R - I, then q_m R for each shape."""
        turn, shift = self.turn_and_shift(steps)
        turned, same = turn.mT, torch.eye(3, dtype=turn.dtype, device=turn.device)
        rigid = torch.cat([shift[:, None], turned - same], dim=1)
        amounts = self._amounts(steps)
        return torch.cat([rigid, (amounts[..., None, None] * turned[:, None]).flatten(1, 2)], dim=1)

    def penalty(self, steps: Tensor) -> Tensor:
        """Prior of the amounts."""
        return self.linear.prior(self._amounts(steps))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> Tensor:
        """Store the amounts in the deformation and return the rotation and translation (4, 4)."""
        self.linear.amounts.copy_(self._amounts(steps[None])[0])
        return super().accept(steps)

    def _amounts(self, steps: Tensor) -> Tensor:
        if self.free:
            return self.start + steps[:, 6:]
        return self.start.to(steps).expand(len(steps), -1)

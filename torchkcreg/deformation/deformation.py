"""What a deformation is to a registration: a field around an implant, and the motions that may be taken from there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.optimization.parameters import ParameterBlock


def combined(features: Tensor, coefficients: Tensor) -> Tensor:
    """Displacements (K, N, 3) of points that know features (N, F), for coefficients (K, F, 3): one product for all."""
    wide = coefficients.transpose(0, 1).flatten(1)
    return (features @ wide).unflatten(1, (-1, 3)).transpose(0, 1)


@dataclass(frozen=True)
class Level:
    """How finely a deformation may move, from coarse to fine (section 2.3 of Cao et al. 2020).

    Attributes:
        groups: Control-point groups of a free-form deformation; 1 moves the whole implant rigidly, whatever the model.
        modes: The groups move along this many of the implant's softest elastic modes; None: each freely.
    """

    groups: int = 1
    modes: int | None = None

    @property
    def is_rigid(self) -> bool:
        """Whether the implant moves as a whole."""
        return self.groups == 1 and self.modes is None


class Motion(ParameterBlock, ABC):
    """Steps of an implant's motion, rigid ones included, from a deformation's present state.

    The displacement of a point is linear in numbers that depend on the steps, ``u(x) = sum_f features_f(x) c_f``:
    what a point needs to know is computed once, and whole batches of candidates are one matrix product.
    """

    @abstractmethod
    def features(self, points: Tensor) -> Tensor:
        """What points (N, 3) of the implant's frame need to know, shape (N, F), float64."""

    @abstractmethod
    def coefficients(self, steps: Tensor) -> Tensor:
        """C of steps (K, D), shape (K, F, 3): whole displacements in the implant's frame, mm, not increments."""

    @abstractmethod
    def accept(self, steps: Tensor) -> Tensor:
        """The rigid motion (4, 4), float64, that steps (D,) leave to the pose; the rest has gone into the deformation.

        ``pose (x + u(x))`` with the steps is ``pose C (x + u'(x))`` with the motion C and the deformation's new u'.
        """

    def keep_covariance(self, covariance: Tensor) -> None:
        """Hears, at a registration's end, the covariance (D, D) of the steps, mm^2; forgets it by default."""

    def displacement(self, points: Tensor, steps: Tensor) -> Tensor:
        """Displacements (K, N, 3) of points (N, 3) after steps (K, D), in the implant's frame, mm."""
        return combined(self.features(points), self.coefficients(steps))


class Deformation(nn.Module, ABC):
    """How an implant bends: a displacement field u of its own frame, ``x -> x + u(x)`` (eq. 1 of Cao et al. 2020).

    A registration knows deformations by this interface alone. A model of your own derives from it or, where its
    displacements are linear in a few amounts, from :class:`LinearDeformation`, which leaves a dozen lines to write.

    Attributes:
        model: What files call the model.
    """

    model: ClassVar[str] = "custom"

    def forward(self, points: Tensor) -> Tensor:
        """Deformed points, same shape and dtype as `points` (..., N, 3), in the implant's frame, mm."""
        return points + self.displacement(points)

    @abstractmethod
    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame, in their dtype."""

    @abstractmethod
    def motion(self, cloud: ImplantPointCloud, level: Level) -> Motion:
        """The steps that a stage may take from here.

        Args:
            cloud: The implant.
            level: How finely.

        Raises:
            ValueError: If the level is coarser than the deformation so far.
        """

    def fixed_at(self, heads: Tensor) -> None:
        """Hears, before it moves, where components are fixed to it, heads (C, 3) in its frame; forgets by default."""

    def surprise(self) -> float:
        """Mean square of what a prior was told of, in its standard deviations: about one or less; 0 without a prior."""
        return 0.0

    def jacobian(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) of x -> x + u(x), [i, j] = d (x + u)_i / d x_j; central differences by default."""
        points, step = points.double(), 1e-3
        sides = torch.stack(
            [
                points + s * step * axis
                for axis in torch.eye(3, dtype=points.dtype, device=points.device)
                for s in (1, -1)
            ]
        )
        moved = self.forward(sides).unflatten(0, (3, 2))
        return ((moved[:, 0] - moved[:, 1]) / (2 * step)).movedim(0, -1)

    def strained(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) at points (..., N, 3) against the implant's shape without load: what strains it."""
        return self.jacobian(points)

    def jacobian_determinant(self, points: Tensor) -> Tensor:
        """Local volume ratio of the deformation at points (..., N, 3), shape (..., N); it folds where negative."""
        return torch.linalg.det(self.jacobian(points))

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., N, 3) where the field only goes on from elsewhere; nowhere by default."""
        return torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)

    @torch.no_grad()
    def reset(self) -> None:
        """Takes all bending back."""
        for parameter in self.parameters():
            parameter.zero_()

    def to_dict(self) -> dict[str, Any]:
        """The deformation as plain types and tensors, for files; "model" names what reads it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be written: it has no to_dict")

    def description(self) -> list[float]:
        """Numbers that tell it from a deformation whose checkpoint would not fit."""
        return [float(sum(parameter.numel() for parameter in self.parameters()))]

"""Interface of deformation models: the displacement field of an implant, and the motions an optimiser may apply."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.optimization.parameters import ParameterBlock


def combined(features: Tensor, coefficients: Tensor) -> Tensor:
    """Displacements (K, N, 3) from features (N, F) of N points and coefficients (K, F, 3) of K candidates.

    All candidates are computed in one matrix product.
    """
    wide = coefficients.transpose(0, 1).flatten(1)
    return (features @ wide).unflatten(1, (-1, 3)).transpose(0, 1)


@dataclass(frozen=True)
class Level:
    """Degrees of freedom of a registration stage; stages go from coarse to fine (section 2.3 of Cao et al. 2020).

    Attributes:
        groups: Number of control-point groups of a free-form deformation. With 1 the whole implant moves rigidly,
            whatever the model.
        modes: Number of the implant's softest elastic modes along which the groups move. If None, each group moves
            freely.
    """

    groups: int = 1
    modes: int | None = None

    @property
    def is_rigid(self) -> bool:
        """True if the implant moves as a rigid whole."""
        return self.groups == 1 and self.modes is None


class Motion(ParameterBlock, ABC):
    """Parametrised motion of an implant (rigid part included), starting from a deformation's current state.

    The parameters are called steps. The displacement of a point is linear in coefficients that depend on the steps:
    `u(x) = sum_f features_f(x) c_f`. The features of the points are computed once, and a whole batch of candidates is
    then one matrix product.
    """

    @abstractmethod
    def features(self, points: Tensor) -> Tensor:
        """Features (N, F), float64, of points (N, 3) in the implant's frame."""

    @abstractmethod
    def coefficients(self, steps: Tensor) -> Tensor:
        """Coefficients c (K, F, 3) for steps (K, D).

        They give total displacements in the implant's frame, mm, not increments.
        """

    @abstractmethod
    def accept(self, steps: Tensor) -> Tensor:
        """Apply steps (D,) to the deformation and return the rigid motion C (4, 4), float64, that belongs to the pose.

        `pose (x + u(x))` with the steps equals `pose C (x + u'(x))` with the deformation's new displacement u'.
        """

    def keep_covariance(self, covariance: Tensor) -> None:
        """Called at a registration's end with the covariance (D, D) of the steps, mm^2. Does nothing by default."""

    def displacement(self, points: Tensor, steps: Tensor) -> Tensor:
        """Displacements (K, N, 3) of points (N, 3) for steps (K, D), in the implant's frame, mm."""
        return combined(self.features(points), self.coefficients(steps))


class Deformation(nn.Module, ABC):
    """Displacement field u of an implant in the implant's frame, `x -> x + u(x)` (eq. 1 of Cao et al. 2020).

    A registration uses deformations only through this interface. To add a model, derive from this class or, if its
    displacements are linear in a few amounts, from `LinearDeformation`, which takes about a dozen lines.

    Attributes:
        model: Name of the model in files.
    """

    model: ClassVar[str] = "custom"

    def forward(self, points: Tensor) -> Tensor:
        """Deformed points, same shape and dtype as `points` (..., N, 3), in the implant's frame, mm."""
        return points + self.displacement(points)

    @abstractmethod
    def displacement(self, points: Tensor) -> Tensor:
        """Displacements u, mm, of points (..., N, 3) in the implant's frame, in the points' dtype."""

    @abstractmethod
    def motion(self, cloud: ImplantPointCloud, level: Level) -> Motion:
        """Motion that a registration stage optimises, starting from the current deformation.

        Args:
            cloud: The implant.
            level: Degrees of freedom of the stage.

        Raises:
            ValueError: If the level is coarser than the current deformation.
        """

    def fixed_at(self, heads: Tensor) -> None:
        """Called before a registration with the heads (C, 3) of the components fixed to the implant.

        Heads are points in the implant's frame. Does nothing by default.
        """

    def surprise(self) -> float:
        """Mean square of the quantities under the prior, in its standard deviations.

        About 1 or less is expected; 0 without a prior.
        """
        return 0.0

    def jacobian(self, points: Tensor) -> Tensor:
        """Jacobians (..., N, 3, 3) of x -> x + u(x), [i, j] = d (x + u)_i / d x_j.

        Central differences by default.
        """
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
        """Jacobians (..., N, 3, 3) at points (..., N, 3) relative to the unloaded shape: these cause strain."""
        return self.jacobian(points)

    def jacobian_determinant(self, points: Tensor) -> Tensor:
        """Local volume ratio of the deformation at points (..., N, 3), shape (..., N); negative where it folds."""
        return torch.linalg.det(self.jacobian(points))

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., N, 3) where the field is extrapolated. By default nowhere."""
        return torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)

    @torch.no_grad()
    def reset(self) -> None:
        """Set the deformation to zero."""
        for parameter in self.parameters():
            parameter.zero_()

    def to_dict(self) -> dict[str, Any]:
        """The deformation as plain types and tensors, for files; the key "model" selects the reader."""
        raise NotImplementedError(f"{type(self).__name__} cannot be written: it has no to_dict")

    def description(self) -> list[float]:
        """Numbers that identify the deformation's structure: a checkpoint only fits if they agree."""
        return [float(sum(parameter.numel() for parameter in self.parameters()))]

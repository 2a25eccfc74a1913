"""Free-form deformation: control points that move in groups or along elastic modes (Cao et al. 2020)."""

from __future__ import annotations

from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.splines.grid import ControlPointGrid

from .deformation import Level, Motion
from .group_motion import GroupMotion
from .modal_motion import ModalMotion
from .penalty import BendingPrior
from .spline_field import SplineField


class FreeFormDeformation(SplineField):
    """Free-form deformation x -> x + u(x) of points in the implant's frame.

    Args:
        grid: Control points (CPs).
        control_points: Initial displacements, mm, in the grid's axes, shape (nx, ny, nz, 3); zero if not given.
        labels: Group of each CP, shape (nx, ny, nz); one group if not given.
        prior: Weights of the penalties on bending; default weights if not given.

    Raises:
        ValueError: If shapes do not fit.

    Example:
        >>> import torch
        >>> from torchkcreg.splines import default_grid
        >>> plate = torch.rand(500, 3) * torch.tensor([12.0, 4.0, 150.0])
        >>> deformation = FreeFormDeformation(default_grid(plate))
        >>> bool((deformation(plate) == plate).all())
        True
    """

    model = "ffd"

    def __init__(
        self,
        grid: ControlPointGrid,
        control_points: Tensor | None = None,
        labels: Tensor | None = None,
        *,
        prior: BendingPrior | None = None,
    ) -> None:
        super().__init__(grid, control_points, labels)
        self.prior = prior or BendingPrior()

    def motion(self, cloud: ImplantPointCloud, level: Level) -> Motion:
        """Motions of groups of control points, either each group freely or all together along elastic modes.

        An implant that spans fewer control points than the level has groups gets as many groups as possible.

        Raises:
            ValueError: If the level has fewer groups than the current deformation: its bending would be lost.
        """
        if level.groups < self.num_groups:
            raise ValueError(
                f"a stage of {level.groups} groups cannot follow one of {self.num_groups}: groups only split"
            )
        groups = GroupMotion(self, cloud, level.groups, self.prior, from_rest=level.modes is not None)
        if level.modes is None:
            return groups
        return ModalMotion(groups, level.modes, self.displacement(groups.elasticity.points).detach())

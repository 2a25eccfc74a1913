"""The outcome of a registration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchkcreg.deformation import FreeFormDeformation, spline_displacement
from torchkcreg.geometry import transform_points

from .config import RegistrationConfig
from .verdict import Status


@dataclass
class RegistrationResult:
    """A registered, deformed implant: ``T(x) = implant_to_world (x + u(x))`` (eq. 1 of Cao et al. 2020).

    Attributes:
        implant_to_world: Global rigid transform, shape (4, 4), float64.
        deformation: Free-form deformation in the implant's frame.
        gc: Gradient correlation of each view at the end, shape (V,).
        history: One record an iteration: stage, iteration, loss, step_mm, seconds.
        config: Options that made the result.
        seed: Seed of the random numbers.
        status: "ok", "doubtful" or "failed": whether the result can be trusted, for the reasons in ``warnings``.
        warnings: What a user should know before trusting the numbers.
        diagnostics: What the verdict rests on, see ``Diagnostics``; ``node_std_mm`` is the expected root mean square
            error of the implant's nodes.
        components: Rigid motion (4, 4) of each component in the implant's frame.
        screws: Screws that were found: start, end and radius in the implant's frame before the motion, mm.
        intensity: Estimated parameters of the intensity model.
    """

    implant_to_world: Tensor
    deformation: FreeFormDeformation
    gc: Tensor
    history: list[dict[str, Any]]
    config: RegistrationConfig
    seed: int = 0
    status: Status = "ok"
    warnings: list[str] = field(default_factory=list)
    diagnostics: dict[str, Any] = field(default_factory=dict)
    components: dict[str, Tensor] = field(default_factory=dict)
    screws: list[dict[str, Any]] = field(default_factory=list)
    intensity: dict[str, float] = field(default_factory=dict)

    @torch.no_grad()
    def warp(self, points: Tensor) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64.

        Points beyond the control-point grid move rigidly with the nearest group; :meth:`outside` flags them.
        """
        flat = points.detach().double().reshape(-1, 3)
        spline = self.deformation
        u = spline_displacement(spline.grid, spline.control_points.double(), flat, labels=spline.labels)
        moved = transform_points(self.implant_to_world.double(), flat + u)
        return moved.reshape(points.shape)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) beyond the valid domain of the control-point grid."""
        return ~self.deformation.grid.contains(points.double())

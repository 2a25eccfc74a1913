"""No stage may lose: what compares it with the one before, and what a state must be to be handed on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points, vector_from_rotation

from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .objective import stage_objective
from .scene import Scene

_PIXEL_MM = 1.5  # nothing finer is needed to see that a stage went astray
_LOST = 1.25  # times what was unexplained before: a stage sees other pixels than its judge
_NEGLIGIBLE = 0.01  # of the images
_LARGEST_STRAIN = 0.02  # root mean square; metal yields at a tenth of it
_LARGEST_TURN_DEG = 60.0
_FURTHEST = 1.5  # lengths of the implant


class Guard:
    """The state of a scene before a stage, and whether the stage made something better of it.

    Args:
        scene: As it is before the stages.
        data: Projections, with the shape of the scatter.
        config: Background, backend.
    """

    def __init__(self, scene: Scene, data: RegistrationData, config: RegistrationConfig) -> None:
        self.scene, self.data, self.config = scene, data, config
        self.first_pose = scene.implant_to_world.clone()
        self.bin, self.misfit = 0, math.nan

    def before(self, stage: Stage) -> None:
        """The scene's present state is the one to go back to, and what it explains the mark."""
        self.kept = self.scene.kept()
        finest = max(1, round(_PIXEL_MM / self.data.geometry.pixel_spacing[1]))
        if (bin := max(stage.bin, finest)) != self.bin:  # else it is known from the end of the stage before
            self.bin, self.misfit = bin, misfit(self.scene, self.data, self.config, bin)

    def after(self) -> str | None:
        """Why the stage was undone, or None where it stands."""
        reason = implausible(self.scene, self.first_pose)
        if reason is None:
            now = misfit(self.scene, self.data, self.config, self.bin)
            if now <= _LOST * self.misfit + _NEGLIGIBLE or (math.isfinite(now) and not math.isfinite(self.misfit)):
                self.misfit = now
                return None
            reason = f"it left {100 * now:.1f} % of the images unexplained, {100 * self.misfit:.1f} % before"
        self.scene.restore(self.kept, self.config.pitch_mm)
        return reason


@torch.no_grad()
def misfit(scene: Scene, data: RegistrationData, config: RegistrationConfig, bin: int) -> float:
    """What a scene leaves of the images unexplained, whatever stage it comes from: 0 is nothing.

    1 - GD with the background that goes with the scene, or 1 - GC where DRRs are path lengths; all pixels alike.
    """
    stage = Stage(groups=scene.num_groups, bin=bin, pitch_factor=2, margin_mm=12.0, background=True, contrast=True)
    objective = stage_objective(scene, data, stage, config)
    return 1 - float(objective.similarities(objective.model.at_rest).mean())


@torch.no_grad()
def rms_strain(scene: Scene) -> float:
    """Root mean square of the strain in the implant."""
    cloud = scene.implant.coarsened(8)
    gradients = scene.deformation.jacobian(cloud.points.double())
    strain = 0.5 * (gradients.mT @ gradients - torch.eye(3).to(gradients))
    share = (cloud.masses / cloud.masses.sum()).double()
    return float((strain.square().sum((-2, -1)) * share).sum().sqrt())


def implausible(scene: Scene, start: Tensor) -> str | None:
    """Why a scene cannot be one that began at pose ``start`` (4, 4); None if it can."""
    if not all(bool(torch.isfinite(value).all()) for value in scene.moving_state().values()):
        return "its parameters are not finite"
    points = scene.implant.points.double()
    moved = transform_points(scene.implant_to_world, points) - transform_points(start, points)
    extent = float((points.amax(0) - points.amin(0)).norm())
    shift = float(moved.mean(0).norm())
    turned = scene.implant_to_world[:3, :3] @ start[:3, :3].T
    turn = math.degrees(float(vector_from_rotation(turned).norm()))
    if shift > _FURTHEST * extent or turn > _LARGEST_TURN_DEG:
        return f"the implant moved by {shift:.0f} mm and {turn:.0f} degrees"
    strain = rms_strain(scene)
    if not strain <= _LARGEST_STRAIN:
        return f"the implant is strained by {100 * strain:.1f} %, far beyond what metal bears"
    return None

"""Check after each stage that it improved the scene and left it plausible; otherwise undo it."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points, vector_from_rotation
from torchkcreg.scene import RegistrationData, Scene
from torchkcreg.similarity import GradientCorrelation, GradientDifference

from .config import RegistrationConfig, Stage, binning
from .estimated_background import data_with_background

_PIXEL_MM = 1.5  # nothing finer is needed to see that a stage went astray
_LOST = 1.25  # times what was unexplained before: a stage sees other pixels than its judge
_NEGLIGIBLE = 0.01  # of the images
_MARGIN_MM = 12.0
_LARGEST_STRAIN = 0.02  # root mean square; metal yields at a tenth of it
_LARGEST_TURN_DEG = 60.0
_FURTHEST = 1.5  # lengths of the implant


class Guard:
    """Keeps a scene's state before a stage and restores it if the stage made it worse.

    Args:
        scene: Scene before the first stage.
        data: Projections, with scatter shapes.
        config: Options of the background.
    """

    def __init__(self, scene: Scene, data: RegistrationData, config: RegistrationConfig) -> None:
        self.scene, self.data, self.config = scene, data, config
        self.first_poses = [assembly.implant_to_world.detach() for assembly in scene]
        self.bin, self.misfit = 0, math.nan
        self.kept: dict[str, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        """Saved state and misfit, as tensors and plain types."""
        return {"kept": self.kept, "bin": self.bin, "misfit": self.misfit, "first_poses": self.first_poses}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state of `state_dict`."""
        self.kept, self.bin, self.misfit = state["kept"], state["bin"], state["misfit"]
        self.first_poses = list(state["first_poses"])

    def before(self, stage: Stage) -> None:
        """Save the scene's present state and its misfit for comparison after the stage."""
        self.kept = self.scene.kept()
        finest = max(1, round(_PIXEL_MM / self.data.geometry.pixel_spacing[1]))
        if (bin := max(stage.bin, finest)) != self.bin:  # else it is known from the end of the stage before
            self.bin, self.misfit = bin, misfit(self.scene, self.data, self.config, bin)

    def after(self) -> str | None:
        """Undo the stage if it made the scene worse; the reason, or None if it was kept.

        Without `undo_stages` only a stage that ends in numbers that are not finite is undone.
        """
        if not _is_finite(self.scene):
            self.scene.restore(self.kept)
            return "its parameters are not finite"
        reason = implausible(self.scene, self.first_poses)
        now = misfit(self.scene, self.data, self.config, self.bin) if reason is None else math.nan
        kept = now <= _LOST * self.misfit + _NEGLIGIBLE or (math.isfinite(now) and not math.isfinite(self.misfit))
        if reason is None and not kept:
            reason = f"it left {100 * now:.1f} % of the images unexplained, {100 * self.misfit:.1f} % before"
        if reason is None or not self.config.undo_stages:
            self.misfit = now
            return None
        self.scene.restore(self.kept)
        return reason


def _is_finite(scene: Scene) -> bool:
    values = [*scene.parameters(), *(assembly.implant_to_world for assembly in scene)]
    return all(bool(torch.isfinite(value).all()) for value in values)


@torch.no_grad()
def misfit(scene: Scene, data: RegistrationData, config: RegistrationConfig, bin: int) -> float:
    """Unexplained share of the images, comparable between stages: 0 is a perfect fit.

    1 - GD with the background estimated for the scene, or 1 - GC if DRRs are path lengths; all pixels weigh the same.
    """
    bin = binning(bin, data.geometry.pixel_spacing[1])
    make: type[GradientCorrelation] | type[GradientDifference] = GradientCorrelation
    if scene.intensity.has_background:
        data, make = data_with_background(scene, data, config, bin), GradientDifference
    view = scene.view(data, bin=bin, pitch_factor=2, margin_mm=_MARGIN_MM)
    return 1 - float(make(view.images.line_integrals, view.images.mask)(scene(view)).mean())


@torch.no_grad()
def implausible(scene: Scene, starts: list[Tensor]) -> str | None:
    """Reason why the scene is implausible for implants that started at poses (4, 4); None if plausible."""
    for assembly, start in zip(scene, starts, strict=True):
        points = assembly.implant.points.double()
        moved = transform_points(assembly.implant_to_world, points) - transform_points(start, points)
        extent = float((points.amax(0) - points.amin(0)).norm())
        shift = float(moved.mean(0).norm())
        turned = assembly.implant_to_world[:3, :3] @ start[:3, :3].T
        turn = math.degrees(float(vector_from_rotation(turned).norm()))
        if shift > _FURTHEST * extent or turn > _LARGEST_TURN_DEG:
            return f"the {assembly.name} moved by {shift:.0f} mm and {turn:.0f} degrees"
        if not (strain := assembly.rms_strain()) <= _LARGEST_STRAIN:
            return f"the {assembly.name} is strained by {100 * strain:.1f} %, far beyond what metal bears"
    return None

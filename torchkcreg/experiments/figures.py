"""Pictures of a registration: start and result over the projections, how the implant bent, how the loss fell."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchkcreg.evaluation import displacement_map
from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.registration import (
    RegistrationData,
    RegistrationResult,
    Scene,
    Stage,
    StageModel,
    stage_objective,
)
from torchkcreg.visualization import displacement_figure, history_figure, overlay_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_VIEWS = 6
_EXAGGERATIONS = (20.0, 10.0, 5.0, 2.0)
_DRAWN_SHARE = 0.05  # of the implant's length: as far as the largest displacement is drawn


def draw_registration(
    result: RegistrationResult, scene: Scene, data: RegistrationData, initial: Tensor
) -> dict[str, Figure]:
    """Figures of a registration by file name: "overlay.png", "displacement.png", "history.png".

    Args:
        result: The registration.
        scene: Its scene in the state it ended in.
        data: What was registered; of more than six views, six are drawn.
        initial: Pose (4, 4) at which the registration started.
    """
    figures = {
        "overlay.png": _overlay(result, scene, data, initial),
        "displacement.png": _displacement(result, scene),
    }
    if result.history:
        labels = [_stage_label(stage) for stage in result.config.schedule()]
        figures["history.png"] = history_figure(result.history, stage_labels=labels)
    return figures


def _stage_label(stage: Stage) -> str:
    if stage.modes is not None:
        return f"{stage.modes} modes"
    return f"{stage.groups} group{'s' * (stage.groups > 1)}"


def start_scene(scene: Scene, initial: Tensor) -> Scene:
    """A copy of a scene with the undeformed implant at its start pose."""
    start = copy.deepcopy(scene)
    with torch.no_grad():
        start.deformation.control_points.zero_()
        start.implant_to_world.copy_(initial)
    return start


def _overlay(result: RegistrationResult, scene: Scene, data: RegistrationData, initial: Tensor) -> Figure:
    views = torch.linspace(0, data.num_views - 1, min(data.num_views, MOST_VIEWS)).round().long().tolist()
    shown = data.select(views)
    start = start_scene(scene, initial)
    return overlay_figure(
        shown.line_integrals,
        _drr(scene, shown, result),
        before=_drr(start, shown, result),
        view_labels=_labels(shown.geometry, views),
        gc_before=_similarity(start, shown, result),
        gc_after=_similarity(scene, shown, result),
        pixel_spacing=shown.geometry.pixel_spacing,
    )


@torch.no_grad()
def _drr(scene: Scene, data: RegistrationData, result: RegistrationResult) -> Tensor:
    """Path lengths (V, rows, cols) of implant and components on the whole detector, mm."""
    groups = result.config.schedule()[-1].groups  # fewer could not hold the result's bending
    stage = Stage(groups=groups, bin=1, pitch_factor=2, oversampling=1, margin_mm=None)
    model = StageModel(scene, data, stage, result.config)
    return model.path_lengths(model.at_rest)[0].sum(dim=0)


@torch.no_grad()
def _similarity(scene: Scene, data: RegistrationData, result: RegistrationResult) -> Tensor:
    """GC (V,) as the result has it, so that start and result are measured alike."""
    stage = result.config.schedule()[-1].model_copy(update={"robust": False, "contrast": False})
    objective = stage_objective(scene, data, stage, result.config)
    return objective.similarities(objective.model.at_rest)[0]


def _labels(geometry: ConeBeamGeometry, views: list[int]) -> list[str]:
    """Titles of the views: angle and source where the geometry knows them."""
    if geometry.angles_deg is None:
        return [f"view {view}" for view in views]
    names = [f"{angle:g}°" for angle in geometry.angles_deg]
    return names if geometry.sources is None else [f"{n}, {s}" for n, s in zip(names, geometry.sources, strict=True)]


def _displacement(result: RegistrationResult, scene: Scene) -> Figure:
    cloud = scene.implant.coarsened(2)
    bent = displacement_map(cloud.points, result.warp(cloud.points), weights=cloud.masses)
    length = float((cloud.bounds[1] - cloud.bounds[0]).max())
    largest = max(float(bent.magnitudes.max()), 1e-9)
    drawn = next((e for e in _EXAGGERATIONS if e * largest <= _DRAWN_SHARE * length), 1.0)
    return displacement_figure(
        bent.undeformed,
        bent.vectors,
        exaggeration=drawn,
        title="bending of the implant, its distal end at rest",
        label="displacement against the distal end (mm)",
    )

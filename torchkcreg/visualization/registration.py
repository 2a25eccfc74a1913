"""Figures of a registration: overlays of start and result on the projections, bending of the implant, and history."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchkcreg.evaluation import displacement_map
from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.registration import RegisteredImplant, RegistrationResult, Stage, StageRun, similarities
from torchkcreg.scene import Assembly, RegistrationData, Scene
from torchkcreg.similarity import GradientCorrelation

from .displacement_map import displacement_figure
from .history import history_figure
from .overlay import overlay_figure, overlay_layers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_VIEWS = 6
_EXAGGERATIONS = (20.0, 10.0, 5.0, 2.0)
_DRAWN_SHARE = 0.05  # largest drawn displacement, as a share of the implant's length


def draw_registration(
    result: RegistrationResult, data: RegistrationData, starts: Sequence[Tensor]
) -> dict[str, Figure]:
    """Figures of a registration by file name: "overlay.png", "displacement.png", "history.png".

    For further implants, the file name of the displacement figure begins with the implant's name.

    Args:
        result: The registration, with its scene.
        data: The registered data; at most six views are drawn.
        starts: Start pose (4, 4) of each implant.

    Raises:
        ValueError: If the result has no scene.
    """
    if result.scene is None:
        raise ValueError("the result has no scene to draw: it was read from files")
    data = replace(data, geometry=result.corrected(data.geometry))
    figures = {"overlay.png": _overlay(result, _as_told(result.scene), data, starts)}
    for number, assembly in enumerate(result.scene):
        prefix = f"{assembly.name}_" if number else ""
        figures[f"{prefix}displacement.png"] = _displacement(result.implants[number], assembly)
    if result.history:
        labels = [_stage_label(stage) for stage in result.config.schedule()]
        figures["history.png"] = history_figure(result.history, stage_labels=labels)
    return figures


def registered_layers(result: RegistrationResult, data: RegistrationData) -> dict[str, Any]:
    """Image layers of up to six views for an HTML page: "grey" and "overlay" (see `overlay_layers`), and "labels"."""
    if result.scene is None:
        raise ValueError("the result has no scene to draw: it was read from files")
    data = replace(data, geometry=result.corrected(data.geometry))
    views = _drawn_views(data)
    shown = data.select(views)
    grey, overlay = overlay_layers(shown.line_integrals, _drr(_as_told(result.scene), shown))
    return {"grey": grey, "overlay": overlay, "labels": np.array(_labels(shown.geometry, views))}


def _stage_label(stage: Stage) -> str:
    name = (
        "rigid" if stage.level.is_rigid else f"{stage.groups} groups" if stage.modes is None else f"{stage.modes} modes"
    )
    return name if stage.bin == 1 else f"{name}, bin {stage.bin}"


def start_scene(scene: Scene, starts: Sequence[Tensor]) -> Scene:
    """A copy of a scene with the undeformed implants at their start poses."""
    start = copy.deepcopy(scene)
    with torch.no_grad():
        for assembly, pose in zip(start, starts, strict=True):
            assembly.deformation.reset()
            assembly.implant_to_world = pose
    return start


def _as_told(scene: Scene) -> Scene:
    """The scene without corrections of views (`view_motions`), for a geometry that already includes them."""
    if scene.view_motions is None:
        return scene
    bare = copy.deepcopy(scene)
    bare.view_motions = None
    return bare


def draw_start(scene: Scene, data: RegistrationData) -> Figure:
    """Overlay of a scene, as it is, on its views; at most six are drawn."""
    views = _drawn_views(data)
    shown = data.select(views)
    return overlay_figure(
        shown.line_integrals,
        _drr(scene, shown),
        view_labels=_labels(shown.geometry, views),
        pixel_spacing=shown.geometry.pixel_spacing,
        label="start",
    )


def _drawn_views(data: RegistrationData) -> list[int]:
    return torch.linspace(0, data.num_views - 1, min(data.num_views, MOST_VIEWS)).round().long().tolist()


def _overlay(result: RegistrationResult, scene: Scene, data: RegistrationData, starts: Sequence[Tensor]) -> Figure:
    views = _drawn_views(data)
    shown = data.select(views)
    start = start_scene(scene, starts)
    return overlay_figure(
        shown.line_integrals,
        _drr(scene, shown),
        before=_drr(start, shown),
        view_labels=_labels(shown.geometry, views),
        gc_before=_similarity(start, shown, result),
        gc_after=_similarity(scene, shown, result),
        pixel_spacing=shown.geometry.pixel_spacing,
    )


@torch.no_grad()
def _drr(scene: Scene, data: RegistrationData) -> Tensor:
    """Path lengths (V, rows, cols) of implants and components on the whole detector, mm."""
    view = scene.view(data.geometry, oversampling=1, pitch_factor=2)
    return scene.path_lengths(view)[0].sum(dim=0)


def _similarity(scene: Scene, data: RegistrationData, result: RegistrationResult) -> Tensor:
    """GC (V,) with the settings of the result's last stage, so that start and result are comparable."""
    run = StageRun(scene, data, result.config.schedule()[-1], result.config)
    run.with_background()
    return similarities(run, GradientCorrelation)


def _labels(geometry: ConeBeamGeometry, views: list[int]) -> list[str]:
    """Titles of the views: angle and source if the geometry has them, otherwise the number."""
    if geometry.angles_deg is None:
        return [f"view {view}" for view in views]
    names = [f"{angle:g}°" for angle in geometry.angles_deg]
    return names if geometry.sources is None else [f"{n}, {s}" for n, s in zip(names, geometry.sources, strict=True)]


def _displacement(implant: RegisteredImplant, assembly: Assembly) -> Figure:
    cloud = assembly.implant.coarsened(2)
    bent = displacement_map(cloud.points, implant.warp(cloud.points), weights=cloud.volumes)
    length = float((cloud.bounds[1] - cloud.bounds[0]).max())
    largest = max(float(bent.magnitudes.max()), 1e-9)
    drawn = next((e for e in _EXAGGERATIONS if e * largest <= _DRAWN_SHARE * length), 1.0)
    return displacement_figure(
        bent.undeformed,
        bent.vectors,
        exaggeration=drawn,
        title=f"bending of the {assembly.name} relative to its distal end",
        label="displacement relative to the distal end (mm)",
    )

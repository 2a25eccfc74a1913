"""From a trainer at its end to a result that says how far it can be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from torchkcreg.scene import RegistrationData, Scene
from torchkcreg.similarity import GradientCorrelation

from .config import RegistrationConfig, Stage
from .diagnosis import diagnose
from .registered_implant import RegisteredImplant
from .result import RegistrationResult
from .stage_run import StageRun, Terms, coarse, similarities
from .verdict import Rival, judge


def finished(
    scene: Scene,
    data: RegistrationData,
    config: RegistrationConfig,
    terms: Terms,
    last: Stage,
    *,
    history: Sequence[dict[str, Any]],
    records: Sequence[dict[str, Any]],
    undone: dict[str, str],
    rival: Rival | None,
    stopped: str | None,
) -> RegistrationResult:
    """The result of a registration whose scene is at its end."""
    run = StageRun(scene, data, last, config, terms=terms)
    run.with_background()
    gc = similarities(run, GradientCorrelation)  # in which every pixel counts alike
    probe = _diagnosed(run, data)
    converged = _converged(history, last) and stopped is None
    found, deviations = diagnose(probe.objective, gc.tolist(), converged=converged, undone=undone, rival=rival)
    status, reasons = judge(found)
    if stopped is not None:
        reasons = [*reasons, f"the registration was ended before its time: {stopped}"]
        status = "doubtful" if status == "ok" else status
    return RegistrationResult(
        implants=[
            RegisteredImplant.of(assembly, has_material=config.material is not None, deviations=own)
            for assembly, own in zip(scene, deviations, strict=True)
        ],
        gc=gc,
        history=list(history),
        stages=list(records),
        config=config,
        seed=config.seed,
        status=status,
        warnings=reasons,
        diagnostics=asdict(found),
        intensity={name: float(value.detach()) for name, value in scene.intensity.named_parameters()},
        blur_mm=_blur_mm(scene, data),
        view_motions=None if scene.view_motions is None else scene.view_motions.matrices(),
        scene=scene,
    )


def _blur_mm(scene: Scene, data: RegistrationData) -> float:
    """The intensity model's blur on the detector."""
    blur = scene.intensity.free.get("blur")
    sigma_px = 0.0 if blur is None else float(getattr(scene.intensity, blur.attribute).detach())
    return sigma_px * math.sqrt(data.geometry.pixel_spacing[0] * data.geometry.pixel_spacing[1])


def _diagnosed(run: StageRun, data: RegistrationData) -> StageRun:
    """The last stage on pixels that are coarse enough to be quick, weighted as it was."""
    probe = coarse(replace(run, data=data))
    if "reweight" in run.stage.before:
        probe.objective = probe.objective.reweighted()
    return probe


def _converged(history: Sequence[dict[str, Any]], last: Stage) -> bool:
    ended = history[-1] if history else {"iteration": 0, "step_mm": 0.0}
    return ended["iteration"] < last.iterations or ended["step_mm"] < 10 * last.tolerance

"""A registration from files to a run folder: read, check, register, evaluate, draw."""

from __future__ import annotations

import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from torchkcreg.geometry import transform_points
from torchkcreg.implant import Component, ImplantPointCloud
from torchkcreg.io import (
    RunFolder,
    read_components,
    read_config,
    read_geometry,
    read_init,
    read_mesh,
    read_projections,
    read_spectrum,
)
from torchkcreg.physics import Spectrum, material
from torchkcreg.registration import (
    Callback,
    ProgressBar,
    RegistrationConfig,
    RegistrationData,
    RegistrationResult,
    Scene,
    Trainer,
    build_scene,
)

from .figures import draw_registration


@dataclass(frozen=True)
class RegistrationFiles:
    """The files of a registration.

    Attributes:
        implant: Closed mesh of the undeformed implant, mm.
        geometry: Projection matrices.
        projections: Intensities or line integrals.
        spectrum: Detected spectrum; None takes a 90 kV tungsten spectrum where a material is named.
        components: Screws that move with the implant.
        init: Approximate pose.
        views: Views to use; None takes all.
        open_beam: Unattenuated intensity where the projections' file does not say it.
        config: Options as YAML or JSON.
    """

    implant: Path
    geometry: Path
    projections: Path
    spectrum: Path | None = None
    components: Path | None = None
    init: Path | None = None
    views: list[int] | None = None
    open_beam: float | None = None
    config: Path | None = None


def resolve_config(path: Path | None, overrides: dict[str, Any]) -> RegistrationConfig:
    """Options of a file with overrides on top.

    Raises:
        ValueError: For unknown keys and wrong values, in one line that names them.
    """
    options = read_config(path) if path else {}
    try:
        return RegistrationConfig.model_validate({**options, **overrides})
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        source = f"config {path}" if path else "options"
        raise ValueError(f"{source}: {'; '.join(problems)}") from None


@dataclass(frozen=True)
class _Inputs:
    implant: ImplantPointCloud
    data: RegistrationData
    components: list[Component]
    spectrum: Spectrum | None
    implant_to_world: Tensor | None
    masked: dict[str, int]


def _read_inputs(files: RegistrationFiles, config: RegistrationConfig) -> _Inputs:
    geometry = read_geometry(files.geometry)
    projections = read_projections(files.projections, open_beam=files.open_beam)
    projections.check_against(geometry)
    if files.views is not None:
        projections, geometry = projections.select(files.views), geometry.select(files.views)
    spectrum = read_spectrum(files.spectrum) if files.spectrum else None
    if config.material is not None:
        material(config.material)
    elif spectrum is not None:
        raise ValueError("a spectrum needs the implant's material: name it with --material")
    specs = read_components(files.components) if files.components else []
    pose = read_init(files.init) if files.init else None
    mesh = read_mesh(files.implant)
    components = [
        Component.screw(c.name, c.start, c.end, c.radius, material=c.material, pitch=config.pitch_mm) for c in specs
    ]
    return _Inputs(
        ImplantPointCloud.from_mesh(mesh, config.pitch_mm),
        RegistrationData(geometry, projections.line_integrals, projections.mask),
        components,
        spectrum,
        pose,
        projections.num_masked,
    )


class _Checkpoints(Callback):
    """Writes a checkpoint after each stage."""

    def __init__(self, run: RunFolder) -> None:
        self.run = run

    def on_stage_end(self, trainer: Trainer, index: int, stage: Any) -> None:
        self.run.save_checkpoint(trainer.state_dict())
        self.run.write_history(trainer.history)


def register_files(
    files: RegistrationFiles,
    out: Path,
    *,
    overrides: dict[str, Any] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    figures: bool = True,
) -> RegistrationResult:
    """The result of a registration whose run folder is written to ``out``.

    All inputs are read and checked before anything is written.

    Args:
        files: What is registered to what.
        out: Run folder.
        overrides: Options that override those of ``files.config``.
        overwrite: Replace a run that is there.
        resume: Continue one; it must have been started with the same files and options.
        figures: Draw overlay, displacement map and history.

    Raises:
        ValueError: If files or options are wrong, or a resumed run was started with other ones.
        FileNotFoundError: If a file is missing.
        FileExistsError: If ``out`` holds a run and neither overwrite nor resume was asked.
    """
    start = time.perf_counter()
    config = resolve_config(files.config, overrides or {})
    inputs = _read_inputs(files, config)
    scene = build_scene(
        inputs.implant,
        config,
        spectrum=inputs.spectrum,
        components=inputs.components,
        implant_to_world=inputs.implant_to_world,
    )
    initial = scene.implant_to_world.clone()
    trainer = Trainer(scene, inputs.data, config, callbacks=[ProgressBar()])
    trainer.check()
    run = RunFolder.create(out, overwrite=overwrite, resume=resume)
    record = _record(files, config)
    if resume:
        _continue(run, trainer, record)
    else:
        run.start(record)
    trainer.callbacks.append(_Checkpoints(run))
    result = trainer.fit()
    for count, reason in ((n, reason) for reason, n in inputs.masked.items() if n):
        result.warnings.append(f"{count} pixels masked: {reason}")
    run.write_metrics(_metrics(result, scene, initial, time.perf_counter() - start))
    if figures:
        for name, figure in draw_registration(result, scene, inputs.data, initial).items():
            run.write_figure(name, figure)
    run.write_result(result, inputs.implant.points, initial_to_world=initial)
    for message in result.warnings:
        warnings.warn(message, stacklevel=2)
    return result


def _record(files: RegistrationFiles, config: RegistrationConfig) -> dict[str, Any]:
    """What config.yaml keeps: files, options and the stages that they resolve to."""
    names = {k: str(v) if isinstance(v, Path) else v for k, v in vars(files).items() if v is not None}
    options = json.loads(config.model_dump_json())
    return {"files": names, "options": options, "schedule": [json.loads(s.model_dump_json()) for s in config.schedule()]}


def _continue(run: RunFolder, trainer: Trainer, record: dict[str, Any]) -> None:
    kept = read_config(run.path / "config.yaml")
    if kept.get("options") != record["options"]:
        changed = sorted(k for k, v in record["options"].items() if kept.get("options", {}).get(k) != v)
        raise ValueError(f"run folder {run.path} was started with other options: {', '.join(changed)}")
    checkpoint = run.load_checkpoint()
    if checkpoint is not None:
        trainer.load_state_dict(checkpoint)


def _metrics(result: RegistrationResult, scene: Scene, initial: Tensor, seconds: float) -> dict[str, Any]:
    points = scene.implant.points.double()
    motion = (result.warp(points) - transform_points(initial, points)).norm(dim=-1)
    return {
        "gc": result.gc.tolist(),
        "mean_motion_mm": float(motion.mean()),
        "largest_motion_mm": float(motion.max()),
        "intensity": result.intensity,
        "seconds": seconds,
        "warnings": result.warnings,
    }

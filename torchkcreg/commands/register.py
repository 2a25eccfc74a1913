"""Register implants from files and write the run folder, or only check the inputs (dry run)."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, fit_rigid, transform_points
from torchkcreg.io import (
    LAYERS,
    RunFolder,
    implausible_magnification,
    read_config,
    write_figure,
    write_geometry,
    write_layers,
)
from torchkcreg.registration import (
    Callback,
    Progress,
    ProgressBar,
    RegistrationConfig,
    RegistrationResult,
    Scene,
    Stage,
    Trainer,
    TrainerState,
    build_scene,
)
from torchkcreg.visualization import draw_registration, draw_start, registered_layers

from .register_inputs import RECORD_KEYS, RegistrationFiles, RegistrationInputs, read_inputs
from .report import write_report

_CHECKPOINT_SECONDS = 5.0
_MOST_NODES_WRITTEN = 30_000


def resolve_config(path: Path | None, overrides: dict[str, Any]) -> RegistrationConfig:
    """Options of a file, with overrides on top; the file may be the `config.yaml` of a run.

    Raises:
        ValueError: For unknown keys and wrong values, in one line that names them.
    """
    options = read_config(path) if path else {}
    if options.keys() == RECORD_KEYS and isinstance(options["options"], dict):
        options = options["options"]
    return RegistrationConfig.of({**options, **overrides}, f"config {path}" if path else "options")


def register_files(
    files: RegistrationFiles,
    out: Path,
    *,
    overrides: dict[str, Any] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    figures: bool = True,
    callbacks: Sequence[Callback] = (),
) -> RegistrationResult:
    """Register implants, write the run folder `out`, and return the result.

    All inputs are read and checked before anything is written. Reasons to doubt the result are given as Python warnings
    and kept in the result, with a status. A failed registration is written too, for inspection.

    Args:
        files: Input files: implants, geometry, projections, ...
        out: Run folder.
        overrides: Options that override those of `files.config`.
        overwrite: Replace an existing run.
        resume: Continue an interrupted run, which must have been started with the same files and options.
        figures: Draw overlay, displacement map and history, and write the report.
        callbacks: Callbacks of the optimization, called after the progress bar and the checkpoints.

    Raises:
        ValueError: If files or options are wrong, or a resumed run was started with others.
        FileNotFoundError: If a file is missing.
        FileExistsError: If `out` holds a run and neither overwrite nor resume is set.
    """
    start = time.perf_counter()
    files, config = files.with_views(), resolve_config(files.config, overrides or {})
    inputs = read_inputs(files, config)
    trainer = prepared_trainer(inputs, config)
    record = run_record(files, config)
    run = RunFolder.create(out, overwrite=overwrite, resume=resume)
    if resume:
        _continue(run, trainer, record)
    else:
        run.start(record)
    result = train(trainer, run, inputs, callbacks=callbacks)
    for message in result.warnings[len(inputs.warnings) :]:
        warnings.warn(message, stacklevel=2)
    write_run(run, result, trainer, inputs, seconds=time.perf_counter() - start, figures=figures)
    return result


def prepared_trainer(inputs: RegistrationInputs, config: RegistrationConfig) -> Trainer:
    """A trainer at the start pose.

    Raises:
        ValueError: If the implant lies outside every view.
    """
    scene = build_scene(inputs.implants, config, spectrum=inputs.spectrum).to(config.device)
    trainer = Trainer(scene, inputs.data.to(config.device), config, callbacks=[ProgressBar()])
    trainer.check()
    return trainer


def find_start(trainer: Trainer, inputs: RegistrationInputs) -> None:
    """Search for implants whose start does not agree with the images; doubts about where they are go to the inputs."""
    trainer.find_start()
    for assembly in trainer.scene:
        nodes = assembly.nodes()
        doubt = implausible_magnification(trainer.data.facing(nodes).geometry, nodes)
        if doubt is not None and doubt not in inputs.warnings:
            inputs.warnings.append(doubt)
            warnings.warn(doubt, stacklevel=3)


def train(
    trainer: Trainer, run: RunFolder, inputs: RegistrationInputs, *, callbacks: Sequence[Callback] = ()
) -> RegistrationResult:
    """Find the start, run the trainer with checkpoints in the run folder; return the result, inputs' warnings first."""
    find_start(trainer, inputs)
    trainer.callbacks += [_Checkpoints(run), *callbacks]
    result = trainer.fit().to("cpu")
    trainer.data = trainer.data.to("cpu")
    result.warnings[:0] = inputs.warnings
    return result


def write_run(
    run: RunFolder,
    result: RegistrationResult,
    trainer: Trainer,
    inputs: RegistrationInputs,
    *,
    seconds: float,
    figures: bool,
    more_metrics: dict[str, Any] | None = None,
) -> None:
    """Write metrics, figures and result of a finished registration to its run folder."""
    starts = trainer.first_poses
    run.write_metrics({**_metrics(result, trainer.scene, starts, seconds), **(more_metrics or {})})
    if figures:
        for name, figure in draw_registration(result, trainer.data, starts).items():
            run.write_figure(name, figure)
        write_layers(run.path / LAYERS, registered_layers(result, trainer.data))
    if result.view_motions is not None:
        write_geometry(run.path / "geometry_corrected.json", result.corrected(trainer.data.geometry))
    run.write_result(result, [sample_of(implant.cloud.points) for implant in inputs.implants], initial_to_world=starts)
    if figures:
        write_report(run.path)


def sample_of(points: Tensor) -> Tensor:
    """At most 30 000 of the points (N, 3): all half a million of a plate would fill 60 MB."""
    if len(points) <= _MOST_NODES_WRITTEN:
        return points
    chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:_MOST_NODES_WRITTEN]
    return points[chosen.sort().values.to(points.device)]


class _Checkpoints(Callback):
    """Write a checkpoint at the first iteration of a stage, every few seconds after it, and at the end of the stage."""

    def __init__(self, run: RunFolder) -> None:
        self.folder, self.last = run, time.perf_counter()

    def on_iteration(self, run: TrainerState, index: int, progress: Progress) -> None:
        if progress.iteration == 1 or time.perf_counter() - self.last > _CHECKPOINT_SECONDS:
            self._save(run)

    def on_stage_end(self, run: TrainerState, index: int, stage: Stage) -> None:
        self._save(run)

    def _save(self, trainer: TrainerState) -> None:
        self.folder.save_checkpoint(trainer.state_dict())
        self.folder.write_history(trainer.history)
        self.last = time.perf_counter()


def run_record(files: RegistrationFiles, config: RegistrationConfig) -> dict[str, Any]:
    """Content of config.yaml: files, options and the resulting schedule of stages."""
    names = {key: _recorded(value) for key, value in vars(files).items() if value is not None}
    schedule = [stage.model_dump(mode="json") for stage in config.schedule()]
    return {"files": names, "options": config.model_dump(mode="json"), "schedule": schedule}


def _recorded(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value.resolve())
    return [_recorded(item) for item in value] if isinstance(value, (list, tuple)) else value


def _continue(run: RunFolder, trainer: Trainer, record: dict[str, Any]) -> None:
    previous = read_config(run.path / "config.yaml")
    for part in ("options", "files"):
        before, now = previous.get(part) or {}, record[part]
        changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
        if changed:
            raise ValueError(f"run folder {run.path} was started with other {part}: {', '.join(changed)}")
    checkpoint = run.load_checkpoint()
    if checkpoint is not None:
        trainer.load_state_dict(checkpoint)


def _metrics(result: RegistrationResult, scene: Scene, starts: Sequence[Tensor], seconds: float) -> dict[str, Any]:
    motions, bendings = {}, {}
    for implant, assembly, start in zip(result.implants, scene, starts, strict=True):
        points = assembly.implant.points.double()
        motions[implant.name] = (implant.warp(points) - transform_points(start, points)).norm(dim=-1)
        bendings[implant.name] = _bending(points, points + implant.displacement(points))
    return {
        "status": result.status,
        "gc": result.gc.tolist(),
        "node_std_mm": result.diagnostics.get("node_std_mm"),
        **_motion(torch.cat(list(motions.values()))),
        "largest_bending_mm": max(bendings.values()),
        "searched": list(result.searched),
        "implants": {name: {**_motion(m), "largest_bending_mm": bendings[name]} for name, m in motions.items()},
        "intensity": result.intensity,
        "screws_found": [screw.to_dict() for screw in result.screws_found],
        "stages": result.stages,
        "diagnostics": {name: v for name, v in result.diagnostics.items() if name not in ("gc", "node_std_mm")},
        "seconds": seconds,
        "warnings": result.warnings,
    }


def _bending(points: Tensor, bent: Tensor) -> float:
    """Largest distance, mm, of bent points (N, 3) from the best rigid fit of the points (N, 3) without bending."""
    return float((transform_points(fit_rigid(points, bent), points) - bent).norm(dim=-1).max())


def _motion(distances: Tensor) -> dict[str, float]:
    """Mean and largest distance of the nodes (N,) from the start pose."""
    return {"mean_motion_mm": float(distances.mean()), "largest_motion_mm": float(distances.max())}


def dry_run(files: RegistrationFiles, picture: Path | None, *, overrides: dict[str, Any] | None = None) -> list[str]:
    """Check the inputs of a registration and report, in lines of text, the implant's start pose in each view.

    Args:
        files: Input files, as for `register_files`.
        picture: PNG to write: the implant at its start pose over the views. No figure if None.
        overrides: Options that override those of `files.config`.

    Raises:
        ValueError, FileNotFoundError: As `register_files`.
    """
    files, config = files.with_views(), resolve_config(files.config, overrides or {})
    inputs = read_inputs(files, config)
    trainer = prepared_trainer(inputs, config)
    find_start(trainer, inputs)
    scene, data = trainer.scene, trainer.data
    lines = []
    if files.view_list is not None:
        lines.append(f"views {', '.join(map(str, files.view_list))}")
    if trainer.searched:
        lines.append(f"searched, since the start pose does not agree with the images: {', '.join(trainer.searched)}")
    for implant, assembly in zip(inputs.implants, scene, strict=True):
        nodes = assembly.nodes(1).reshape(-1, 3).detach().cpu().double()
        size = " x ".join(f"{x:.1f}" for x in (nodes.amax(0) - nodes.amin(0)).tolist())
        middle = ", ".join(f"{x:.1f}" for x in ((nodes.amax(0) + nodes.amin(0)) / 2).tolist())
        material = config.material or "path length alone"
        lines.append(f"{implant.name}: {len(nodes)} nodes, {size} mm about ({middle}) in the world, {material}")
        lines += [f"  {line}" for line in _in_views(nodes, data.geometry.cpu())]
    lines.append(f"{len(trainer.stages)} stages; nothing was registered")
    if picture is not None:
        write_figure(picture, draw_start(scene.cpu(), data.to("cpu")))
        lines.append(f"picture {picture}")
    return lines


def _in_views(nodes: Tensor, geometry: ConeBeamGeometry) -> list[str]:
    """Position and magnification of nodes (N, 3) in each view, a line per view."""
    uv, depth = geometry.project(nodes)
    rows, cols = geometry.det_shape
    inside = ((uv > -0.5) & (uv < uv.new_tensor([cols - 0.5, rows - 0.5]))).all(-1).double().mean(-1)
    low, high = uv.amin(1), uv.amax(1)
    magnified = geometry.detector_distances / depth.median(-1).values
    lines = []
    for view in range(geometry.num_views):
        angle = "" if geometry.angles_deg is None else f" ({geometry.angles_deg[view]:g} degrees)"
        span = [f"{float(low[view, k]):.0f} to {float(high[view, k]):.0f}" for k in (0, 1)]
        lines.append(
            f"view {view}{angle}: columns {span[0]} of {cols}, rows {span[1]} of {rows}, "
            f"{100 * float(inside[view]):.0f} % within the image, magnified {float(magnified[view]):.2f} times"
        )
    return lines

"""The loop of a registration: stage after stage, from one rigid group to many (section 2.3 of the paper)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from torchkcreg.callbacks import Callback
from torchkcreg.optimization import OPTIMIZERS, Progress
from torchkcreg.progress import progress_bar
from torchkcreg.scene import RegistrationData, Scene
from torchkcreg.similarity import GradientCorrelation

from .config import PHYSICS, RegistrationConfig, Stage
from .diagnosis import diagnose
from .estimated_background import facing_data
from .guard import Guard
from .registered_implant import RegisteredImplant
from .result import RegistrationResult
from .stage import StageRun, Step, Terms, coarse, similarities
from .start import find_start
from .steps import AFTER, BEFORE, CHANGE_SCENE, rigid_stages
from .verdict import Rival, judge

log = logging.getLogger(__name__)


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
    searched: tuple[str, ...] = (),
) -> RegistrationResult:
    """The result of a registration from its final scene."""
    run = StageRun(scene, data, last, config, terms=terms)
    run.with_background()
    gc = similarities(run, GradientCorrelation)  # with uniform pixel weights
    probe = _diagnosed(run, data)
    converged = _converged(history, last) and stopped is None
    diagnostics, deviations = diagnose(probe.objective, gc.tolist(), converged=converged, undone=undone, rival=rival)
    status, reasons = judge(diagnostics)
    if stopped is not None:
        reasons = [*reasons, f"the registration was ended before its time: {stopped}"]
        status = "doubtful" if status == "ok" else status
    return RegistrationResult(
        implants=[
            RegisteredImplant.of(assembly, has_material=config.material is not None, deviations=of_implant)
            for assembly, of_implant in zip(scene, deviations, strict=True)
        ],
        gc=gc,
        history=list(history),
        stages=list(records),
        config=config,
        seed=config.seed,
        searched=searched,
        status=status,
        warnings=reasons,
        diagnostics=asdict(diagnostics),
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
    """The last stage on coarser pixels, with the same kind of weights."""
    probe = coarse(replace(run, data=data))
    if "reweight" in run.stage.before:
        probe.objective = probe.objective.reweighted()
    return probe


def _converged(history: Sequence[dict[str, Any]], last: Stage) -> bool:
    ended = history[-1] if history else {"iteration": 0, "step_mm": 0.0}
    return ended["iteration"] < last.iterations or ended["step_mm"] < 10 * last.tolerance


class TrainerState(Protocol):
    """Interface of a running registration for callbacks."""

    scene: Scene
    stages: tuple[Stage, ...]
    history: list[dict[str, Any]]

    def state_dict(self) -> dict[str, Any]:
        """A checkpoint from which a run resumes with bit-identical results."""

    def stop(self, reason: str) -> None:
        """End the registration after the current iteration."""


class ProgressBar(Callback):
    """A tqdm bar for each stage, with the loss and the last step."""

    def __init__(self, disable: bool | None = None) -> None:
        self.disable = disable  # None: only on a terminal
        self._bar: tqdm | None = None

    def on_stage_start(self, run: TrainerState, index: int, stage: Stage) -> None:
        """Open the stage's bar."""
        groups = "1 group" if stage.groups == 1 else f"{stage.groups} groups"
        name = f"stage {index + 1}/{len(run.stages)}: {groups}, {stage.optimizer}"
        shown = None if self.disable is None else not self.disable
        self._bar = progress_bar(total=stage.iterations, desc=name, shown=shown)

    def on_iteration(self, run: TrainerState, index: int, progress: Progress) -> None:
        """Advance the bar."""
        if self._bar is not None:
            self._bar.set_postfix(loss=f"{progress.loss:.5f}", step_mm=f"{progress.step_mm:.4f}", refresh=False)
            self._bar.update(progress.iteration - self._bar.n)

    def on_stage_end(self, run: TrainerState, index: int, stage: Stage) -> None:
        """Close the bar."""
        if self._bar is not None:
            self._bar.close()


@dataclass(frozen=True)
class StageRecord:
    """Outcome of a stage.

    Attributes:
        iterations: Number of iterations.
        converged: True if it ended before its iterations or the time ran out.
        loss: Loss at the end.
        undone: Reason why the stage was undone; None if it was kept.
    """

    iterations: int
    converged: bool
    loss: float
    undone: str | None = None


class Trainer:
    """Runs the stages of a configuration on a scene and keeps their history.

    Args:
        scene: Scene to register; its poses, deformations and intensity model are updated in place.
        data: Measured data.
        config: Stages, penalties, seed.
        callbacks: Called at the start and end of stages and after each iteration.
        terms: Similarity, penalties and optimiser that replace or extend the stages'.
        steps: Additional steps, by the names used in stages.
        seconds: Time limit; after it the registration ends with the current iteration.

    A checkpoint (`state_dict`) is complete at any time: a trainer that loads it continues with the next iteration and
    ends with bit-identical results.

    Raises:
        ValueError: If the implant lies behind a source at its start pose, or a stage names an unknown step, optimiser
            or parameter.
    """

    def __init__(
        self,
        scene: Scene,
        data: RegistrationData,
        config: RegistrationConfig,
        *,
        callbacks: Sequence[Callback] = (),
        terms: Terms | None = None,
        steps: Mapping[str, Step] | None = None,
        seconds: float | None = None,
    ) -> None:
        self.scene, self.config, self.callbacks = scene, config, list(callbacks)
        self.data = facing_data(scene, data, config)
        self.stages = config.schedule()
        self.terms = terms or Terms()
        self.steps = {**BEFORE, **AFTER, **(steps or {})}
        self._check_names()
        self.next_stage = 0
        self.history: list[dict[str, Any]] = []
        self.records: list[StageRecord] = []
        self.rival: Rival | None = None
        self.searched: tuple[str, ...] | None = None  # None: not looked at yet
        self.stopped: str | None = None
        self._deadline = None if seconds is None else time.perf_counter() + seconds
        self._guard = Guard(scene, self.data, config)
        self._run: StageRun | None = None
        self._kept_run: dict[str, Any] | None = None

    def _check_names(self) -> None:
        for stage in self.stages:
            for name in (*stage.before, *stage.after):
                if name not in self.steps:
                    raise ValueError(f"there is no step {name!r}: steps are {', '.join(sorted(self.steps))}")
            if stage.optimizer not in OPTIMIZERS and self.terms.optimizer is None:
                raise ValueError(f"optimizer must be one of {', '.join(OPTIMIZERS)}, got {stage.optimizer!r}")
            free = self.scene.intensity.free
            known = {"screws", "tilts", "views", *(free or PHYSICS)}  # plain path lengths leave physics out
            if unknown := sorted(set(stage.estimate) - known):
                raise ValueError(f"{unknown[0]!r} cannot be estimated: {', '.join(sorted(known))} can")

    def check(self) -> None:
        """Raise ValueError if an implant lies outside every view at its start pose, and is not to be searched."""
        if self.config.start != "given":
            return
        margin = (self.stages[0].margin_mm or 0.0) / self.data.geometry.pixel_spacing[1]
        for assembly in self.scene:
            self.data.windowed(assembly.nodes(1), margin)

    def stop(self, reason: str) -> None:
        """End the registration after the current iteration; the result gives the reason."""
        self.stopped = reason

    @torch.enable_grad()
    def fit(self) -> RegistrationResult:
        """Run the remaining stages and return the result, with gradients even inside `torch.no_grad()`."""
        self.run()
        return finished(
            self.scene,
            self.data,
            self.config,
            self.terms,
            self.stages[-1],
            history=self.history,
            records=[asdict(record) for record in self.records],
            undone=self.undone,
            rival=self.rival,
            stopped=self.stopped,
            searched=self.searched or (),
        )

    def run(self) -> float:
        """Run the remaining stages, after a search for the start if need be, and return the misfit."""
        self.find_start()
        while self.next_stage < len(self.stages) and self.stopped is None:
            self._run_stage(self.next_stage)
        return self._guard.misfit

    def find_start(self) -> None:
        """Search for implants whose start pose does not agree with the images, once; `fit` does it first."""
        if self.searched is not None:
            return
        found = find_start(self.scene, self.data, self.config, self._rigid_trial)
        self.searched, self.rival = found.names, found.rival
        if found.names:
            log.info("searched for: %s", ", ".join(found.names))
            self._guard = Guard(self.scene, self.data, self.config)

    @property
    def first_poses(self) -> list[Tensor]:
        """Pose (4, 4) of each implant from which the stages began."""
        return [pose.cpu() for pose in self._guard.first_poses]

    def _rigid_trial(self, scene: Scene, data: RegistrationData) -> float:
        return self._trial(rigid_stages(self.stages), scene, data)

    def _run_stage(self, index: int) -> None:
        stage, start = self.stages[index], time.perf_counter()
        for callback in self.callbacks:
            callback.on_stage_start(self, index, stage)
        run = self._begun(index)

        def report(progress: Progress) -> None:
            record = {"stage": index, "iteration": progress.iteration, "loss": progress.loss}
            self.history.append({**record, "step_mm": progress.step_mm, "seconds": time.perf_counter() - start})
            for callback in self.callbacks:
                callback.on_iteration(self, index, progress)
            if self._deadline is not None and time.perf_counter() > self._deadline:
                self.stop("its time was up")

        for progress in run.reports:  # of a step that ran the optimiser itself
            report(progress)
        run.optimize(report, stop=lambda: self.stopped is not None)
        for name in stage.after:
            self.steps[name](run)
        optimizer = run.begin()
        if not run.accepted:
            run.accept(optimizer.best())
        self.rival = min(filter(None, (run.rival, self.rival)), key=lambda rival: rival.ratio, default=None)
        undone = self._guard.after()
        last = optimizer.progress
        self.records.append(StageRecord(last.iteration, optimizer.converged, last.loss, undone))
        log.info(
            "stage %d of %d (%d groups, %s): %d iterations, loss %.5f%s",
            *(index + 1, len(self.stages), stage.groups, stage.optimizer, last.iteration, last.loss),
            ", undone" if undone else "",
        )
        self.next_stage, self._run = index + 1, None
        for callback in self.callbacks:
            callback.on_stage_end(self, index, stage)

    def _begun(self, index: int) -> StageRun:
        """The run of a stage after its preparing steps, or the run restored from a checkpoint."""
        stage, optimizer_state = self.stages[index], self._kept_run
        names = stage.before
        if optimizer_state is None:
            self._guard.before(stage)
        else:
            names = tuple(name for name in names if name not in CHANGE_SCENE)
        run = StageRun(
            self.scene,
            self.data,
            stage,
            self.config,
            terms=self.terms,
            seed=self.config.seed + index,
            remaining=[self.steps[name] for name in names],
            following=self.stages[index + 1 :],
            trial=self._trial,
        )
        run.prepare()
        optimizer = run.begin()
        if optimizer_state is not None:
            optimizer.load_state_dict(optimizer_state)
        self._run, self._kept_run = run, None
        return run

    def _trial(
        self, stages: tuple[Stage, ...], scene: Scene | None = None, data: RegistrationData | None = None
    ) -> float:
        config = self.config.model_copy(update={"stages": stages, "start": "given"})
        with torch.enable_grad():
            return Trainer(scene or self.scene, data or self.data, config, terms=self.terms, steps=self.steps).run()

    @property
    def undone(self) -> dict[str, str]:
        """Number of each stage that was undone, from 1 on, and why."""
        return {str(i): record.undone for i, record in enumerate(self.records, start=1) if record.undone is not None}

    def state_dict(self) -> dict[str, Any]:
        """Checkpoint for `load_state_dict`, as tensors and plain types."""
        run = self._run
        return {
            "registered": self.scene.description(),
            "scene": self.scene.kept(),
            "searched": None if self.searched is None else list(self.searched),
            "next_stage": self.next_stage,
            "history": self.history,
            "records": [asdict(record) for record in self.records],
            "rival": None if self.rival is None else asdict(self.rival),
            "guard": self._guard.state_dict(),
            "optimizer": None if run is None or run.optimizer is None else run.optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint of the same scene and configuration.

        Raises:
            ValueError: If the checkpoint belongs to another scene.
        """
        expected, given = self.scene.description(), state.get("registered", {})
        if differ := sorted(n for n in expected.keys() | given.keys() if expected.get(n) != given.get(n)):
            raise ValueError(f"the checkpoint does not fit this registration: {', '.join(differ)} differ")
        self.scene.restore(state["scene"])
        self.searched = None if state["searched"] is None else tuple(state["searched"])
        self.next_stage, self.history = int(state["next_stage"]), list(state["history"])
        self.records = [StageRecord(**record) for record in state["records"]]
        self.rival = None if state["rival"] is None else Rival(**state["rival"])
        self._guard.load_state_dict(state["guard"])
        self._kept_run = state["optimizer"]

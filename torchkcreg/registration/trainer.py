"""The loop of a registration: stage after stage, from one rigid group to many (section 2.3 of the paper)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from .basins import Rival, places
from .callbacks import Callback
from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .found_screw import FoundScrew
from .guard import Guard
from .objective import StageObjective, stage_objective, with_scatter_shapes
from .optimizers import Progress, minimize
from .result import RegistrationResult
from .scene import Scene
from .screws import find_screws, of_best_metal, screws_by_metal
from .verdict import Diagnostics, diagnose, judge

_SCREW_BIN = 8  # a screw is thinner than a coarser pixel


class Trainer:
    """Runs the stages of a configuration on a scene and keeps their history.

    Args:
        scene: What is registered; its pose, deformation and intensity model are updated in place.
        data: What it is registered to.
        config: Stages, penalties, seed.
        callbacks: Called at the start and end of stages and after each iteration.

    A checkpoint (:meth:`state_dict`) is complete at the end of a stage: a trainer that loads it continues with the
    next stage and ends with the same bits as one that was never stopped.

    Raises:
        ValueError: If the implant lies behind a source at its start pose.
    """

    def __init__(
        self, scene: Scene, data: RegistrationData, config: RegistrationConfig, *, callbacks: Sequence[Callback] = ()
    ) -> None:
        self.scene, self.config, self.callbacks = scene, config, list(callbacks)
        self.data = with_scatter_shapes(scene, data.facing(scene.nodes()), config)
        self.stages = config.schedule()
        self.next_stage = 0
        self.history: list[dict[str, Any]] = []
        self.undone: dict[str, str] = {}
        self.rival: Rival | None = None
        self._guard = Guard(scene, self.data, config)

    def check(self) -> None:
        """Raises ValueError if the implant lies outside every view at its start pose."""
        points = self.scene.nodes(1)
        self.data.windowed(points, (self.stages[0].margin_mm or 0.0) / self.data.geometry.pixel_spacing[1])

    def fit(self) -> RegistrationResult:
        """Runs the stages that are left and returns the result."""
        self.run()
        return self._result()

    def run(self) -> float:
        """Runs the stages that are left; what of the images they leave unexplained."""
        while self.next_stage < len(self.stages):
            self._run_stage(self.next_stage)
        return self._guard.misfit

    def _run_stage(self, index: int) -> None:
        stage, start = self.stages[index], time.perf_counter()
        for callback in self.callbacks:
            callback.on_stage_start(self, index, stage)
        self._guard.before(stage)
        if stage.screws == "choose" and self.scene.holes:
            self._choose_metal(stage, index)
        else:
            self._look_for_screws(stage)
        objective = stage_objective(self.scene, self.data, stage, self.config)

        def report(progress: Progress) -> None:
            record = {"stage": index, "iteration": progress.iteration, "loss": progress.loss}
            seconds = time.perf_counter() - start
            self.history.append({**record, "step_mm": progress.step_mm, "seconds": seconds})
            for callback in self.callbacks:
                callback.on_iteration(self, index, progress)

        found = minimize(objective, stage, seed=self.config.seed + index, report=report)
        if stage.slide:
            self._try_places(index, objective, found)
        else:
            objective.accept(found)
        if (reason := self._guard.after()) is not None:
            self.undone[str(index + 1)] = reason
        self.next_stage = index + 1
        for callback in self.callbacks:
            callback.on_stage_end(self, index, stage)

    def _try_places(self, index: int, objective: StageObjective, found: Tensor) -> None:
        """Moves the scene to the place from which the rigid stages explain the images best."""
        candidates = places(objective, found)
        if len(candidates) == 1:
            return objective.accept(found)
        before, ends = self.scene.kept(), []
        config = self.config.model_copy(update={"stages": self._rigid_stages(index)})
        for candidate in candidates:
            self.scene.restore(before, self.config.pitch_mm)
            objective.accept(candidate)
            trial = Trainer(self.scene, self.data, config)
            ends.append((trial.run(), self.scene.nodes(), self.scene.kept()))
        (best, nodes, state), (second, elsewhere, _), *_ = sorted(ends, key=lambda end: end[0])
        self.scene.restore(state, self.config.pitch_mm)
        distance = float((nodes - elsewhere).square().sum(-1).mean().sqrt())
        self.rival = Rival(distance_mm=distance, misfit=second, best_misfit=best)
        return None

    def _rigid_stages(self, index: int) -> tuple[Stage, ...]:
        """A stage's own and those that follow it and keep the implant rigid; one look for screws, none for places."""
        following = itertools.takewhile(lambda s: s.groups == 1 and s.modes is None, self.stages[index + 1 :])
        first, *others = [s.model_copy(update={"slide": False}) for s in (self.stages[index], *following)]
        bare = {"screws": None}
        return (first.model_copy(update=bare), *others[:1], *(s.model_copy(update=bare) for s in others[1:]))

    def _look_for_screws(self, stage: Stage) -> None:
        if stage.screws != "find" or not self.scene.holes:
            return
        self.scene.place(
            find_screws(self.scene, self.data, self.config, bin=min(stage.bin, _SCREW_BIN)), self.config.pitch_mm
        )

    def _choose_metal(self, stage: Stage, seed: int) -> None:
        """Places the screws of the metal with which the stage ends best: coarse images without it tell metals badly."""
        options = screws_by_metal(self.scene, self.data, self.config, bin=min(stage.bin, _SCREW_BIN))
        ends = []
        for screws, _ in options:
            self.scene.place(screws, self.config.pitch_mm)
            objective = stage_objective(self.scene, self.data, stage, self.config)
            end = minimize(objective, stage, seed=self.config.seed + seed, report=lambda progress: None)
            ends.append((screws, float(objective.losses(end[None])[0])))
        self.scene.place(of_best_metal(ends), self.config.pitch_mm)

    def _result(self) -> RegistrationResult:
        scene = self.scene
        # What is reported is gradient correlation, in which every pixel counts alike.
        whole = self.stages[-1].model_copy(update={"robust": False, "contrast": False})
        final = stage_objective(scene, self.data, whole, self.config)
        with torch.no_grad():
            gc = final.similarities(final.model.at_rest)[0]
        intensity = {name: float(value.detach()) for name, value in scene.intensity.named_parameters()}
        found = self._diagnostics(gc.tolist())
        status, reasons = judge(found)
        return RegistrationResult(
            implant_to_world=scene.implant_to_world.clone(),
            deformation=scene.deformation,
            gc=gc,
            history=self.history,
            config=self.config,
            seed=self.config.seed,
            status=status,
            warnings=reasons,
            diagnostics=asdict(found),
            components=scene.component_motions(),
            intensity=intensity,
            screws=[asdict(screw) for screw in self.scene.found],
        )

    def _diagnostics(self, gc: list[float]) -> Diagnostics:
        last = self.stages[-1]
        coarse = last.model_copy(update={"bin": max(last.bin, 2)})
        objective = stage_objective(self.scene, self.data, coarse, self.config)
        ended = self.history[-1] if self.history else {"iteration": 0, "step_mm": 0.0}
        converged = ended["iteration"] < last.iterations or ended["step_mm"] < 10 * last.tolerance
        return diagnose(self.scene, objective, gc, converged=converged, undone=self.undone, rival=self.rival)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain types that :meth:`load_state_dict` continues from."""
        return {
            "registered": self.scene.description(),
            "scene": self.scene.moving_state(),
            "next_stage": self.next_stage,
            "history": self.history,
            "screws": [asdict(screw) for screw in self.scene.found],
            "tilts": self.scene.tilts.clone(),
            "undone": self.undone,
            "rival": None if self.rival is None else asdict(self.rival),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a checkpoint of the same scene and configuration.

        Raises:
            ValueError: If the checkpoint belongs to another scene.
        """
        own, theirs = self.scene.description(), state.get("registered", {})
        if differ := sorted(n for n in own.keys() | theirs.keys() if own.get(n) != theirs.get(n)):
            raise ValueError(f"the checkpoint does not fit this registration: {', '.join(differ)} differ")
        found = [FoundScrew(**screw) for screw in state["screws"]]
        self.scene.restore((state["scene"], found, state["tilts"]), self.config.pitch_mm)
        self.next_stage, self.history = int(state["next_stage"]), list(state["history"])
        self.undone = dict(state["undone"])
        self.rival = None if state["rival"] is None else Rival(**state["rival"])

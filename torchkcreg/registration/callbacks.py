"""Callbacks of a registration: progress bar, and whatever a user adds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tqdm import tqdm

from .config import Stage
from .optimizers import Progress

if TYPE_CHECKING:
    from .trainer import Trainer


class Callback:
    """Base class: override what you need; every method does nothing here."""

    def on_stage_start(self, trainer: Trainer, index: int, stage: Stage) -> None:
        """Before a stage runs."""

    def on_iteration(self, trainer: Trainer, index: int, progress: Progress) -> None:
        """After each iteration of a stage's optimiser."""

    def on_stage_end(self, trainer: Trainer, index: int, stage: Stage) -> None:
        """After a stage; ``trainer.state_dict()`` is a checkpoint from which a run resumes bit by bit."""


class ProgressBar(Callback):
    """A tqdm bar a stage, with the loss and the last step."""

    def __init__(self, disable: bool | None = None) -> None:
        self.disable = disable  # None: only on a terminal
        self._bar: tqdm | None = None

    def on_stage_start(self, trainer: Trainer, index: int, stage: Stage) -> None:
        """Opens the stage's bar."""
        groups = "1 group" if stage.groups == 1 else f"{stage.groups} groups"
        name = f"stage {index + 1}/{len(trainer.stages)}: {groups}, {stage.optimizer}"
        self._bar = tqdm(total=stage.iterations, desc=name, disable=self.disable, leave=True)

    def on_iteration(self, trainer: Trainer, index: int, progress: Progress) -> None:
        """Moves the bar on."""
        if self._bar is not None:
            self._bar.set_postfix(loss=f"{progress.loss:.5f}", step_mm=f"{progress.step_mm:.4f}", refresh=False)
            self._bar.update(progress.iteration - self._bar.n)

    def on_stage_end(self, trainer: Trainer, index: int, stage: Stage) -> None:
        """Closes the bar."""
        if self._bar is not None:
            self._bar.close()

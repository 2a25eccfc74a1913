"""What callbacks of a registration may do, and the progress bar."""

from __future__ import annotations

from typing import Any, Protocol

from tqdm import tqdm

from torchkcreg.callbacks import Callback
from torchkcreg.optimization import Progress
from torchkcreg.progress import progress_bar
from torchkcreg.scene import Scene

from .config import Stage


class TrainerState(Protocol):
    """What callbacks may look at, and do, while a registration runs."""

    scene: Scene
    stages: tuple[Stage, ...]
    history: list[dict[str, Any]]

    def state_dict(self) -> dict[str, Any]:
        """A checkpoint from which a run resumes bit by bit."""

    def stop(self, reason: str) -> None:
        """Ends the registration after the present iteration."""


class ProgressBar(Callback):
    """A tqdm bar a stage, with the loss and the last step."""

    def __init__(self, disable: bool | None = None) -> None:
        self.disable = disable  # None: only on a terminal
        self._bar: tqdm | None = None

    def on_stage_start(self, run: TrainerState, index: int, stage: Stage) -> None:
        """Opens the stage's bar."""
        groups = "1 group" if stage.groups == 1 else f"{stage.groups} groups"
        name = f"stage {index + 1}/{len(run.stages)}: {groups}, {stage.optimizer}"
        shown = None if self.disable is None else not self.disable
        self._bar = progress_bar(total=stage.iterations, desc=name, shown=shown)

    def on_iteration(self, run: TrainerState, index: int, progress: Progress) -> None:
        """Moves the bar on."""
        if self._bar is not None:
            self._bar.set_postfix(loss=f"{progress.loss:.5f}", step_mm=f"{progress.step_mm:.4f}", refresh=False)
            self._bar.update(progress.iteration - self._bar.n)

    def on_stage_end(self, run: TrainerState, index: int, stage: Stage) -> None:
        """Closes the bar."""
        if self._bar is not None:
            self._bar.close()

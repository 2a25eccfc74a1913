"""What follows a long work along, a registration or a reconstruction: pictures, checkpoints, a way to stop it."""

from __future__ import annotations

from typing import Any


class Callback:
    """Base class: override what you need; every method does nothing here.

    A registration has stages, an iterative reconstruction passes; both have iterations. ``run`` is the trainer or the
    solver; ``run.state_dict()`` is a checkpoint from which it goes on bit by bit, at any time.
    """

    def on_stage_start(self, run: Any, index: int, stage: Any) -> None:
        """Before a stage, or a pass, with its options."""

    def on_iteration(self, run: Any, index: int, progress: Any) -> None:
        """After each iteration of a stage or pass, with its record."""

    def on_stage_end(self, run: Any, index: int, stage: Any) -> None:
        """After a stage or pass."""

"""Callbacks of long computations (registration, reconstruction): pictures, checkpoints, early stopping."""

from __future__ import annotations

from typing import Any


class Callback:
    """Base class of callbacks. Override the methods you need; by default they do nothing.

    A registration has stages, an iterative reconstruction has passes; both have iterations. `run` is the trainer or the
    solver. `run.state_dict()` is a checkpoint, at any time, from which it continues with bit-identical results.
    """

    def on_stage_start(self, run: Any, index: int, stage: Any) -> None:
        """Called before a stage or pass, with its options."""

    def on_iteration(self, run: Any, index: int, progress: Any) -> None:
        """Called after each iteration of a stage or pass, with its record."""

    def on_stage_end(self, run: Any, index: int, stage: Any) -> None:
        """Called after a stage or pass."""

"""Figure of a registration's history: loss, gradient correlation and step sizes over its iterations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .style import BLUE, GREEN, RED, new_figure, open_frame

_PANELS = (("loss", "loss", False), ("gc", "gradient correlation", False), ("step_mm", "step (mm)", True))
_COLOURS = (BLUE, GREEN, RED)


def history_figure(history: Sequence[dict[str, Any]], *, stage_labels: Sequence[str] | None = None) -> Figure:
    """A figure of a registration's history over its iterations, with the stages marked.

    Args:
        history: Records in order, each with `loss` and, if known, `gc` (mean of the views), `step_mm`, `stage` (an
            increasing number), and `evaluations` (candidates tried so far). The horizontal axis shows `evaluations` if
            every record has them, otherwise the number of the record.
        stage_labels: A short label for each stage ("5 groups").

    Raises:
        ValueError: The history is empty, or no record has a `loss`.
    """
    if not history or not any(record.get("loss") is not None for record in history):
        raise ValueError("history must hold at least one record with a loss")
    counted = all(record.get("evaluations") is not None for record in history)
    x = np.array([r["evaluations"] if counted else i + 1 for i, r in enumerate(history)], dtype=float)
    stages = [record.get("stage", 0) for record in history]
    spans = _spans(x, stages)
    panels = [panel for panel in _PANELS if any(record.get(panel[0]) is not None for record in history)]

    figure = new_figure(8.5, 0.6 + 2.3 * len(panels))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (key, label, logarithmic), colour in zip(axes, panels, _COLOURS):
        y = np.array([np.nan if r.get(key) is None else float(r[key]) for r in history])
        _curve(axis, x, y, stages, colour, logarithmic and bool((y[np.isfinite(y)] > 0).any()))
        axis.set_ylabel(label)
        _mark_stages(axis, spans)
    _name_stages(axes[0], spans, stage_labels)
    figure.text(0.01, 0.005, "each stage has a loss of its own: compare within a stage", fontsize=7, color="0.4")
    axes[-1].set_xlabel("evaluations" if counted else "iteration")
    axes[-1].set_xlim(x[0] - 0.5, x[-1] + 0.5)
    return figure


def _curve(axis: Axes, x: NDArray, y: NDArray, stages: list[Any], colour: str, logarithmic: bool) -> None:
    """Draw one line for each stage: the loss may be defined differently in each, so lines are not connected."""
    for stage in dict.fromkeys(stages):
        inside = np.array([s == stage for s in stages])
        axis.plot(x[inside], y[inside], color=colour, linewidth=1.4, marker="o", markersize=2.8)
    if logarithmic:
        axis.set_yscale("log", nonpositive="mask")
    axis.grid(True, color="0.92", linewidth=0.6)
    open_frame(axis)


def _spans(x: NDArray, stages: list[Any]) -> list[tuple[Any, float, float]]:
    """Each stage with the horizontal positions of its start and end."""
    firsts = [i for i in range(len(x)) if i == 0 or stages[i] != stages[i - 1]]
    edges = [x[0] - 0.5, *((x[i - 1] + x[i]) / 2 for i in firsts[1:]), x[-1] + 0.5]
    return [(stages[i], float(left), float(right)) for i, (left, right) in zip(firsts, pairwise(edges))]


def _mark_stages(axis: Axes, spans: list[tuple[Any, float, float]]) -> None:
    for i, (_, left, right) in enumerate(spans):
        if i % 2:
            axis.axvspan(left, right, color="0.96", zorder=-1)
        if i:
            axis.axvline(left, color="0.6", linewidth=0.8, linestyle="--")


def _name_stages(axis: Axes, spans: list[tuple[Any, float, float]], labels: Sequence[str] | None) -> None:
    total = spans[-1][2] - spans[0][1]
    tilt = any(right - left < 0.1 * total for _, left, right in spans)
    for i, (stage, left, right) in enumerate(spans):
        known = labels is not None and isinstance(stage, int) and 0 <= stage < len(labels)
        axis.annotate(
            labels[stage] if labels is not None and known else f"stage {i + 1}",
            ((left + right) / 2, 1.01),
            xycoords=("data", "axes fraction"),
            ha="left" if tilt else "center",
            va="bottom",
            fontsize=8,
            rotation=30 if tilt else 0,
            rotation_mode="anchor",
            color="0.25",
        )

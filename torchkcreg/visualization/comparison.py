"""Figures of motion: of an implant and its fragments under load, and of an implant over a series of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.evaluation import AXES, RelativeMotion

from .style import COLOURS, new_figure, open_frame

_COLOURS = dict(zip(AXES, COLOURS[:3], strict=True))


def comparison_figure(motions: Sequence[RelativeMotion], names: Sequence[str], loads: Sequence[float] = ()) -> Figure:
    """A figure of deflections relative to the lower fragment, with bands of one standard deviation.

    With loads it also shows the fragments' relative rotation and translation over the load.

    Args:
        motions: Relative motion of each loaded run.
        names: Names of the runs.
        loads: Load of each run, N; without it no curves over the load are drawn.
    """
    figure = new_figure(9.5, 6.4 if loads else 4.6)
    parts: Any = figure.subfigures(2, 1, height_ratios=[3, 2]) if loads else [figure]
    panels = parts[0].subplots(3, 1, sharex=True)
    shades = colormaps["viridis"](np.linspace(0.0, 0.85, len(motions)))
    for row, (panel, axis) in enumerate(zip(panels, AXES, strict=True)):
        for motion, name, shade in zip(motions, names, shades, strict=True):
            height, value, std = (
                x.cpu().numpy()
                for x in (motion.heights, motion.deflection_mm[:, row], motion.deflection_std_mm[:, row])
            )
            panel.fill_between(height, value - std, value + std, color=shade, alpha=0.25, linewidth=0)
            panel.plot(height, value, color=shade, label=name)
        panel.axhline(0, color="0.6", linewidth=0.8, zorder=0)
        panel.set_ylabel(f"{axis}\n(mm)")
    panels[0].set_title("deflection along the implant, relative to the lower fragment", fontsize=11)
    panels[0].legend(frameon=False, fontsize=9, ncols=2)
    panels[-1].set_xlabel("position along the implant (mm)")
    if loads:
        _curves(parts[1], motions, loads)
    for axes in figure.axes:
        open_frame(axes)
    return figure


def _curves(figure, motions: Sequence[RelativeMotion], loads: Sequence[float]) -> None:
    turns, shifts = figure.subplots(1, 2)
    for row, axis in enumerate(AXES):
        for panel, part, unit in ((turns, 0, "degrees"), (shifts, 3, "mm")):
            value, std = (np.array([float(m.numbers[k][part + row]) for m in motions]) for k in (0, 1))
            panel.errorbar(loads, value, std, color=_COLOURS[axis], label=axis, marker="o", markersize=4, capsize=2)
            panel.set_xlabel("load (N)")
            panel.set_ylabel(f"{'rotation' if part == 0 else 'translation at the gap'} ({unit})")
    turns.legend(frameon=False, fontsize=9)


def frames_figure(values: Tensor, std: Tensor, names: Sequence[str], *, title: str = "") -> Figure:
    """Rotation and translation in each frame, with bars of one standard deviation.

    Args:
        values: Rotation vector (degrees) and translation (mm) in each frame, (F, 6); NaN leaves a gap.
        std: Standard deviations (F, 6); NaN draws no bar.
        names: Names of the frames.
        title: Written above.
    """
    figure = new_figure(8.5, 5.2)
    places = np.arange(len(names))
    for panel, part, label in zip(
        figure.subplots(2, 1, sharex=True), (0, 3), ("rotation (degrees)", "translation (mm)"), strict=True
    ):
        for row, axis in enumerate("xyz"):
            value, error = (x[:, part + row].cpu().numpy() for x in (values, std))
            bars = np.where(np.isfinite(error), error, 0.0)
            style = {"marker": "o", "markersize": 4, "capsize": 2, "color": COLOURS[row]}
            panel.errorbar(places, value, bars, label=axis, **style)
        panel.axhline(0, color="0.6", linewidth=0.8, zorder=0)
        panel.set_ylabel(label)
        open_frame(panel)
    figure.axes[0].legend(frameon=False, fontsize=9, ncols=3)
    figure.axes[0].set_title(title, fontsize=11)
    turned = 0 if sum(map(len, names)) < 60 else 45
    figure.axes[1].set_xticks(places, names, rotation=turned, ha="right" if turned else "center")
    figure.axes[1].set_xlabel("frame")
    return figure


def healing_figure(
    days: Sequence[float], curves: Mapping[str, Sequence[tuple[float, float] | None]], *, xlabel: str = "days"
) -> Figure:
    """Quantities of a fracture over time, one panel each, with bars of one standard deviation.

    Args:
        days: Time of each visit.
        curves: Value and standard deviation at each visit, None where it was not measured, by the panel's title.
        xlabel: Name of the time.
    """
    figure = new_figure(8.5, 1.4 + 1.7 * len(curves))
    panels = np.atleast_1d(figure.subplots(len(curves), 1, sharex=True))
    for panel, (title, numbers) in zip(panels, curves.items(), strict=True):
        known = [(day, *number) for day, number in zip(days, numbers, strict=True) if number is not None]
        time, value, std = (np.array(column) for column in zip(*known, strict=True))
        bars = np.where(np.isfinite(std), std, 0.0)
        panel.errorbar(time, value, bars, color=COLOURS[0], marker="o", markersize=5, capsize=3)
        panel.set_title(title, fontsize=10, loc="left")
        panel.set_ylim(bottom=min(0.0, float((value - bars).min())))
        open_frame(panel)
    panels[-1].set_xlabel(xlabel)
    return figure

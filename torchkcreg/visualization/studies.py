"""Figures of studies of many registrations.

Errors, verdicts, coverage, geometry errors, loads, planned views, and capture range.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from .style import AMBER, BLUE, COLOURS, GREEN, RED, SKY, new_figure, open_frame

_STATUS = {"ok": (BLUE, BLUE), "doubtful": (AMBER, "none"), "failed": (RED, "none")}
_AGAINST = {"azimuth": "gantry angle (degrees; 90: face on)", "scatter": "scatter", "gc": "gradient correlation"}
_MM_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_SIZES = (10, 7, 5, 3)  # decreasing sizes, so that coinciding points stay visible


def errors_figure(rows: Sequence[Mapping[str, Any]], *, right_mm: float) -> Figure:
    """Errors over azimuth, scatter and gradient correlation; cases with verdict "doubtful" or "failed" are hollow."""
    figure = new_figure(12, 3.6)
    axes = figure.subplots(1, 3, sharey=True)
    for axis, (name, label) in zip(axes, _AGAINST.items(), strict=True):
        for status, (edge, face) in _STATUS.items():
            shown = [row for row in rows if row["status"] == status]
            x, y = [row[name] for row in shown], [row["worst"] for row in shown]
            axis.scatter(x, y, s=28, facecolors=face, edgecolors=edge, label=status)
        axis.axhline(right_mm, color="0.8", zorder=0)
        axis.set(xlabel=label, yscale="log")
    axes[0].set_ylabel("largest of bead RMSE,\nnode RMSE, node maximum / 3 (mm)")
    axes[2].legend(frameon=False)
    return figure


def verdict_figure(rows: Sequence[Mapping[str, Any]], *, wrong_mm: float, right_mm: float) -> Figure:
    """Errors over expected errors, and missed failures and false alarms for each threshold of the expected error."""
    expected = np.array([row["node_std_mm"] for row in rows])
    worst = np.array([row["worst"] for row in rows])
    wrong, right = worst > wrong_mm, worst < right_mm
    thresholds = np.linspace(0.01, 0.2, 191)
    figure = new_figure(9, 3.6)
    left, curve = figure.subplots(1, 2)
    left.scatter(expected, worst, s=24, color=BLUE)
    left.axhline(wrong_mm, color="0.8", zorder=0)
    left.set(
        xlabel="expected error of the nodes, node_std_mm (mm)",
        ylabel="largest error measure (mm)",
        xscale="log",
        yscale="log",
    )
    _ticks(left.xaxis, expected)
    missed = [float((wrong & (expected <= t)).sum()) for t in thresholds]
    idle = [float((right & (expected > t)).sum()) for t in thresholds]
    curve.step(thresholds, missed, where="post", color=RED, label=f"missed, of {wrong.sum()} above {wrong_mm} mm")
    curve.step(thresholds, idle, where="post", color=BLUE, label=f"false alarms, of {right.sum()} below {right_mm} mm")
    curve.set(xlabel="threshold of node_std_mm (mm)", ylabel="number of registrations")
    curve.legend(frameon=False)
    return figure


def coverage_figure(widths: Sequence[float], curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Share of true positions inside intervals over the half width in standard deviations, a panel per set of cases."""
    figure = new_figure(4.4 * len(curves), 3.8)
    axes = np.atleast_1d(figure.subplots(1, len(curves), sharey=True))
    normal = [math.erf(width / math.sqrt(2)) for width in widths]
    for axis, (title, parts) in zip(axes, curves.items(), strict=True):
        axis.plot(widths, normal, color="0.6", linestyle="--", label="normal distribution")
        for (name, curve), colour in zip(parts.items(), (BLUE, SKY, RED, AMBER), strict=True):
            axis.plot(widths, curve, color=colour, label=name)
        axis.set(xlabel="half width (stated standard deviations)", title=title)
    axes[0].set_ylabel("share of true positions inside")
    axes[-1].legend(frameon=False)
    return figure


def geometry_figure(
    errors: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]], labels: Mapping[str, str]
) -> Figure:
    """Registration errors of all cases for each kind of geometry error, without and with correction.

    Args:
        errors: Errors in mm by panel title, by name of the geometry error, and by way of registration.
        labels: Labels of the ways of registration.
    """
    figure = new_figure(11.0, 3.8)
    axes = figure.subplots(1, len(errors), sharey=True)
    for axis, (title, names) in zip(axes, errors.items(), strict=True):
        for place, ways in enumerate(names.values()):
            for number, (way, colour) in enumerate(zip(labels, (RED, BLUE), strict=False)):
                x, values = place + 0.3 * (number - 0.5), np.array(ways[way])
                spread = np.linspace(-0.09, 0.09, len(values)) if len(values) > 1 else np.zeros(1)
                words = labels[way] if not place else None
                axis.scatter(x + spread, values, s=16, color=colour, alpha=0.55, label=words)
                axis.hlines(np.median(values), x - 0.12, x + 0.12, color=colour, linewidth=2.5)
        axis.set(xticks=range(len(names)), xticklabels=list(names), yscale="log", title=title)
        axis.set_xlabel("error of the geometry")
    axes[0].set_ylabel("error (mm, RMS)")
    every = [v for names in errors.values() for ways in names.values() for values in ways.values() for v in values]
    _ticks(axes[0].yaxis, np.array(every))
    axes[0].legend(frameon=False)
    return figure


def loads_figure(loads: Sequence[float], curves: Mapping[str, Sequence[Sequence[float]]]) -> Figure:
    """Errors over the load: one dot for each registration, with the medians connected.

    Args:
        loads: Axial loads, N.
        curves: Errors in mm for each load, by label of the curve.
    """
    figure = new_figure(6.0, 3.8)
    axis = figure.subplots()
    for (name, errors), colour in zip(curves.items(), (RED, AMBER, BLUE, SKY), strict=False):
        known = [(load, values) for load, values in zip(loads, errors, strict=True) if values]
        axis.scatter(
            [x for x, values in known for _ in values],
            [y for _, values in known for y in values],
            12,
            colour,
            alpha=0.5,
        )
        axis.plot([x for x, _ in known], [float(np.median(values)) for _, values in known], color=colour, label=name)
    axis.set(xlabel="axial load (N)", ylabel="error of the nodes (mm, RMS)")
    axis.set_ylim(bottom=0)
    axis.legend(frameon=False)
    return figure


def planned_figure(expected: Sequence[float], found: Sequence[float], planned: Sequence[bool]) -> Figure:
    """Errors of sets of views over the errors expected before imaging; planned sets are filled."""
    figure = new_figure(5.0, 4.2)
    axis, chosen = figure.subplots(), np.array(planned, dtype=bool)
    x, y = np.array(expected), np.array(found)
    axis.scatter(x[~chosen], y[~chosen], s=24, facecolors="none", edgecolors="0.5", label="random views")
    axis.scatter(x[chosen], y[chosen], s=36, color=GREEN, label="planned views")
    axis.set(xlabel="expected error (mm)", ylabel="error of the nodes (mm, RMS)", xscale="log", yscale="log")
    _ticks(axis.xaxis, x)
    _ticks(axis.yaxis, y)
    axis.legend(frameon=False)
    return figure


def _ticks(axis: Any, values: np.ndarray) -> None:
    """Set ticks in plain millimetres instead of powers of ten on a logarithmic axis."""
    inside = [t for t in _MM_TICKS if 0.7 * values.min() <= t <= 1.4 * values.max()]
    axis.set_ticks(inside, [f"{t:g}" for t in inside])
    axis.set_minor_formatter("")


def capture_figure(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    *,
    required: tuple[float, float] | None = None,
    captured_mm: float = 0.2,
) -> Figure:
    """A figure of the share of captured starts over their offset, one curve for each name.

    Args:
        curves: Offsets (mm and degrees) and captured shares (0 to 1) by name; up to four curves.
        required: An offset and the share required there, marked by a cross.
        captured_mm: Starts that end below this error count as captured; for the label.

    Raises:
        ValueError: There is no curve, there are more than four, or offsets and shares of a curve differ in number.
    """
    if not 0 < len(curves) <= len(_SIZES):
        raise ValueError(f"there must be one to {len(_SIZES)} curves, got {len(curves)}")
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    for (name, (offsets, shares)), colour, size in zip(curves.items(), COLOURS, _SIZES):
        if len(offsets) != len(shares) or not offsets:
            raise ValueError(f"curve {name!r} has {len(offsets)} offsets and {len(shares)} shares")
        axes.plot(offsets, shares, "o-", color=colour, markersize=size, label=name, clip_on=False, zorder=3)
    if required is not None:
        offset, share = required
        axes.plot([offset], [share], "x", color="0.2", markersize=9, label=f"required: {share:.0%} at {offset:g}")
    axes.set(xlim=(0, None), ylim=(0, 1.05))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("offset of the start (mm and degrees)")
    axes.set_ylabel(f"starts with final rigid error < {captured_mm:g} mm")
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    open_frame(axes)
    return figure

"""Figures of displacement maps: the deformed implant coloured by displacement (fig. 3B of the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from torchkcreg.geometry import principal_axes

from .style import new_figure, open_frame

COLOUR_MAP = "viridis"
_MOST_NODES = 40000
_HEIGHT_IN = 6.5
_TURN_DEG, _TILT_DEG = 40.0, 25.0
_EXAGGERATIONS = (20.0, 10.0, 5.0, 2.0, 1.0)
_DRAWN_SHARE = 0.1  # largest drawn displacement, as a share of the implant's length
_PANEL_HEIGHT_IN, _PANEL_WIDTH_IN = 5.5, 1.25


@dataclass(frozen=True)
class _Upright:
    """Nodes in the implant's axes (width, thickness, length) before and after, their displacements, and dot size."""

    before: NDArray
    after: NDArray
    lengths: NDArray
    dot_area: float  # points^2
    inch_per_mm: float


def displacement_figure(
    undeformed: Tensor,
    vectors: Tensor,
    *,
    exaggeration: float = 1.0,
    limit_mm: float | None = None,
    title: str | None = None,
    label: str = "displacement (mm)",
) -> Figure:
    """A figure of an implant from its flat side, its edge and obliquely, with nodes coloured by their displacement.

    The undeformed implant is drawn in grey behind it. The views follow the implant's principal axes, with the long axis
    upright and the end that is up in the world on top. All views have the same scale.

    Args:
        undeformed: Undeformed nodes (N, 3) in the world, mm, such as
            `torchkcreg.evaluation.DisplacementMap.undeformed`.
        vectors: Displacements (N, 3) of the nodes, mm.
        exaggeration: Factor by which displacements are drawn too large. Colours and numbers are not exaggerated.
        limit_mm: Upper end of the colour scale; the largest displacement if None.
        title: Title of the figure.
        label: Label of the colour bar.

    Raises:
        ValueError: The shapes do not match, or there are fewer than three nodes.
    """
    if undeformed.ndim != 2 or undeformed.shape[-1] != 3 or undeformed.shape != vectors.shape or len(undeformed) < 3:
        shapes = f"{tuple(undeformed.shape)} and {tuple(vectors.shape)}"
        raise ValueError(f"undeformed and vectors must both have shape (N, 3), N > 2, got {shapes}")
    largest = float(torch.linalg.vector_norm(vectors.detach(), dim=-1).max())
    norm = Normalize(0, limit_mm if limit_mm is not None else max(largest, 1e-6))
    nodes = _upright(undeformed, vectors, exaggeration)
    views = [
        ("flat side", _projection(0, 0)),
        ("edge", _projection(90, 0)),
        ("oblique", _projection(_TURN_DEG, _TILT_DEG)),
    ]
    limits = [_limits(nodes, frame) for _, frame in views]
    widths = [(right - left) * nodes.inch_per_mm for left, right in limits]
    figure = new_figure(sum(widths) + 2.6, _HEIGHT_IN + 1.0)
    axes = figure.subplots(1, len(views), gridspec_kw={"width_ratios": widths}, sharey=True)
    for axis, (name, frame), limit in zip(axes, views, limits):
        dots = _draw(axis, nodes, frame, norm)
        axis.set_title(name, fontsize=10)
        axis.set_xlim(limit)
    axes[0].set_ylabel("along the implant (mm)")
    axes[2].set_axis_off()  # oblique lengths are foreshortened
    figure.colorbar(dots, ax=axes, label=label, shrink=0.8, pad=0.04, aspect=35)
    drawn = "" if exaggeration == 1 else f", drawn {exaggeration:g} times too large"
    figure.suptitle((f"{title}\n" if title else "") + f"largest {largest:.2f} mm{drawn}", fontsize=11)
    return figure


def _upright(undeformed: Tensor, vectors: Tensor, exaggeration: float) -> _Upright:
    keep = torch.linspace(0, len(undeformed) - 1, min(len(undeformed), _MOST_NODES)).round().long()
    before = undeformed.detach().cpu().double()
    center = before.mean(0)
    axes = torch.linalg.eigh((before - center).mT @ (before - center)).eigenvectors  # thickness, width, length
    length = axes[:, 2] if axes[2, 2] >= 0 else -axes[:, 2]
    width = axes[:, 1] if axes[:, 1].abs().max() == axes[:, 1].max() else -axes[:, 1]
    frame = torch.stack([width, torch.linalg.cross(length, width), length], dim=-1)
    step = vectors.detach().cpu().double()[keep]
    start = ((before[keep] - center) @ frame).numpy()
    end = start + exaggeration * (step @ frame).numpy()
    inch_per_mm = _HEIGHT_IN / max(float(np.ptp(np.concatenate([start, end])[:, 2])), 1e-6)
    neighbours, _ = cKDTree(start).query(start[:: max(1, len(start) // 1000)], k=2)
    dot = 72 * inch_per_mm * 1.3 * float(np.median(neighbours[:, 1]))
    return _Upright(start, end, step.norm(dim=-1).numpy(), float(np.clip(dot, 1.2, 12)) ** 2, inch_per_mm)


def _projection(turn_deg: float, tilt_deg: float) -> NDArray:
    """View frame (3, 3) with columns right, up and towards the viewer, turned about the long axis, then tilted."""
    turn, tilt = np.deg2rad([turn_deg, tilt_deg])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    towards = np.array([np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt), np.sin(tilt)])
    return np.stack([right, np.cross(towards, right), towards], axis=-1)


def _limits(nodes: _Upright, frame: NDArray) -> tuple[float, float]:
    """Horizontal limits of a view: the implant with a margin, but wide enough for the ticks."""
    right = np.concatenate([nodes.before, nodes.after]) @ frame[:, 0]
    half = max(0.55 * float(np.ptp(right)) + 1.0, 0.45 / nodes.inch_per_mm)
    middle = float(right.max() + right.min()) / 2
    return middle - half, middle + half


def _draw(axes: Axes, nodes: _Upright, frame: NDArray, norm: Normalize) -> PathCollection:
    before, after = nodes.before @ frame, nodes.after @ frame
    order = np.argsort(after[:, 2])  # near nodes over far ones
    size = nodes.dot_area
    axes.scatter(before[:, 0], before[:, 1], s=size, color="0.82", linewidths=0, rasterized=True)
    right, up, _ = after[order].T
    colours = nodes.lengths[order]
    dots = axes.scatter(right, up, s=size, c=colours, cmap=COLOUR_MAP, norm=norm, linewidths=0, rasterized=True)
    axes.set_aspect("equal")
    axes.set_xlabel("mm")
    axes.margins(y=0.02)
    axes.xaxis.set_major_locator(MaxNLocator(2, integer=True))
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    open_frame(axes)
    return dots


def series_figure(panels: Mapping[str, tuple[Tensor, Tensor]], *, label: str) -> Figure:
    """A figure of an implant from its edge, one panel for each configuration, with the undeformed implant in grey.

    Args:
        panels: Undeformed nodes (N, 3) in the world and their displacements (N, 3), mm, by panel title.
        label: Label of the colour bar.

    Raises:
        ValueError: If there is no panel.
    """
    if not panels:
        raise ValueError("there is nothing to draw")
    lengths = {name: vectors.norm(dim=1).numpy() for name, (_, vectors) in panels.items()}
    largest = max(float(length.max()) for length in lengths.values())
    norm = Normalize(0.0, max(largest, 1e-9))
    figure = new_figure(_PANEL_WIDTH_IN * len(panels) + 1.4, _PANEL_HEIGHT_IN)
    columns = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (name, (nodes, vectors)) in zip(columns, panels.items(), strict=True):
        _, directions = principal_axes(nodes)
        thin, long = directions[0].numpy(), directions[-1].numpy()
        thin, long = thin * np.sign(thin[np.abs(thin).argmax()]), long * np.sign(long[2] or 1.0)
        size = float(np.ptp(nodes.numpy() @ long))
        exaggeration = next((x for x in _EXAGGERATIONS if x * largest <= _DRAWN_SHARE * size), 1.0)
        positions, steps = (nodes - nodes.mean(0)).numpy(), exaggeration * vectors.numpy()
        axes.scatter(positions @ thin, positions @ long, s=1, c="0.8", linewidths=0)
        axes.scatter(
            (positions + steps) @ thin,
            (positions + steps) @ long,
            s=1,
            c=lengths[name],
            cmap=COLOUR_MAP,
            norm=norm,
            linewidths=0,
        )
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(f"{name}\n{lengths[name].max():.2f} mm", fontsize=9)
    figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=list(columns), label=label, shrink=0.7)
    figure.suptitle(f"displacements drawn {exaggeration:g} times as large", fontsize=9)
    return figure

"""Figures of a registration's errors: error map of the implant, and histograms (fig. 4B of the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from .displacement_map import _HEIGHT_IN, _draw, _limits, _projection, _upright
from .style import AMBER, BLUE, GREEN, new_figure, open_frame

_VIEWS = (("front", 0.0, 0.0), ("back", 180.0, 0.0), ("edge", 90.0, 0.0), ("oblique", 40.0, 25.0))
_DOT = 2.0  # larger dots, because random samples leave gaps
_COLOURS = ("0.55", BLUE, AMBER, GREEN)


def error_map_figure(
    points: Tensor,
    errors: Tensor,
    *,
    limit_mm: float | None = None,
    title: str | None = None,
    label: str = "error (mm)",
) -> Figure:
    """A figure of an implant from both flat sides, its edge and obliquely, with points coloured by their error.

    Args:
        points: Points (N, 3) of the errors in the world, mm.
        errors: Distances (N,), mm.
        limit_mm: Upper end of the colour scale; larger errors have its last colour. By default the 99.5 % quantile.
        title: Title of the figure.
        label: Label of the colour bar.

    Raises:
        ValueError: The shapes do not match, or there are fewer than three points.
    """
    if points.ndim != 2 or points.shape[-1] != 3 or points.shape[:1] != errors.shape or len(points) < 3:
        shapes = f"{tuple(points.shape)} and {tuple(errors.shape)}"
        raise ValueError(f"points and errors must have shapes (N, 3) and (N,), N > 2, got {shapes}")
    values = errors.detach().cpu().double()
    largest = float(values.max())
    limit = limit_mm if limit_mm is not None else max(float(np.quantile(values.numpy(), 0.995)), 1e-6)
    along = torch.zeros_like(points)
    along[:, 0] = values.to(points)  # errors as displacements that are not drawn: same colours and thinning
    nodes = _upright(points, along, 0.0)
    nodes = replace(nodes, after=nodes.before, dot_area=_DOT * nodes.dot_area)
    frames = [_projection(turn, tilt) for _, turn, tilt in _VIEWS]
    limits = [_limits(nodes, frame) for frame in frames]
    widths = [(right - left) * nodes.inch_per_mm for left, right in limits]
    figure = new_figure(sum(widths) + 3.0, _HEIGHT_IN + 1.0)
    axes = figure.subplots(1, len(_VIEWS), gridspec_kw={"width_ratios": widths}, sharey=True)
    for axis, (name, *_), frame, view in zip(axes, _VIEWS, frames, limits):
        dots = _draw(axis, nodes, frame, Normalize(0, limit))
        axis.set_title(name, fontsize=10)
        axis.set_xlim(view)
    axes[0].set_ylabel("along the implant (mm)")
    axes[-1].set_axis_off()  # oblique lengths are foreshortened
    extend = "max" if largest > limit else "neither"
    figure.colorbar(dots, ax=axes, label=label, shrink=0.8, pad=0.04, aspect=35, extend=extend)
    rmse = float(values.square().mean().sqrt())
    numbers = f"mean {float(values.mean()):.3f}, RMSE {rmse:.3f}, largest {largest:.3f} mm"
    figure.suptitle((f"{title}\n" if title else "") + numbers, fontsize=11)
    return figure


def histogram_figure(
    distances: Mapping[str, Tensor],
    *,
    fwhm_mm: Mapping[str, float] | None = None,
    floor_mm: float | None = None,
    num_bins: int = 80,
    xlabel: str = "error (mm)",
    title: str | None = None,
) -> Figure:
    """A figure of one to four histograms on one axis, as share of points per bin, with their means.

    Args:
        distances: Distances (N,) in mm by name; up to four sets.
        fwhm_mm: Full widths at half maximum by the same names, for the legend.
        floor_mm: Mean distance between perfect clouds, drawn as a line.
        num_bins: Number of bins up to the 99.5 % quantile; the last bin also holds all larger distances.
        xlabel: Label of the horizontal axis.
        title: Title of the figure.

    Raises:
        ValueError: There is no set, an empty one, or more than four.
    """
    if not 0 < len(distances) <= len(_COLOURS) or any(len(values) == 0 for values in distances.values()):
        raise ValueError(f"distances must be one to {len(_COLOURS)} sets, none of them empty, got {len(distances)}")
    arrays = {name: values.detach().cpu().double().numpy() for name, values in distances.items()}
    end = max(max(float(np.quantile(values, 0.995)) for values in arrays.values()), 1e-6)
    edges = np.linspace(0, end, num_bins + 1)
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    for (name, values), colour in zip(arrays.items(), _COLOURS):
        width = "" if fwhm_mm is None or name not in fwhm_mm else f", FWHM {fwhm_mm[name]:.3f}"
        share = np.full(len(values), 100 / len(values))
        text = f"{name}: mean {values.mean():.3f}{width} mm"
        axes.hist(np.minimum(values, end), edges.tolist(), weights=share, color=colour, alpha=0.65, label=text)
        axes.axvline(values.mean(), color=colour, linewidth=1.4)
    if floor_mm is not None:
        axes.axvline(floor_mm, color="0.2", linewidth=1.2, linestyle="--", label=f"perfect lattices: {floor_mm:.3f} mm")
    axes.set_xlim(0, end)
    axes.set_xlabel(xlabel)
    axes.set_ylabel("share of points (%)")
    axes.legend(frameon=False, fontsize=9)
    open_frame(axes)
    if title:
        axes.set_title(title, fontsize=11)
    return figure

"""Figures of reconstructions: slices, differences and profiles (fig. 5 of the paper), and an estimated spectrum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from torch import Tensor

from torchkcreg.geometry import VolumeGrid
from torchkcreg.physics import Beam

from .style import COLOURS, new_figure, open_frame

_COLOURS = ("0.25", *COLOURS[:4])
_LEAST_SHARE = 0.98  # smallest share of a metal in a pixel's path through metal, to be drawn for that metal


def reconstruction_figure(
    volumes: Mapping[str, Tensor],
    grid: VolumeGrid,
    *,
    heights_mm: Sequence[float] = (0.0,),
    window: tuple[float, float] | None = None,
    difference: tuple[str, str] | None = None,
    profile_y_mm: float | None = None,
    metal: Tensor | None = None,
    unit: str = "1/mm",
) -> Figure:
    """A figure of axial slices, one column for each volume and one row for each height.

    A difference of two volumes and a profile are optional.

    Args:
        volumes: Volumes (D, H, W) by title, all on the same grid without rotation.
        grid: Voxel grid of the volumes.
        heights_mm: Heights z of the slices; the nearest slices are drawn.
        window: Values drawn black and white; from the first volume's 1 % and 99.5 % quantiles if None.
        difference: Titles of two volumes; an extra column shows the first minus the second.
        profile_y_mm: If given, a profile along x at this y and the last height is drawn below the slices.
        metal: Share of metal (D, H, W), outlined in yellow at 0.5.
        unit: Unit of the values, for the profile's axis.

    Raises:
        ValueError: There is no volume, a volume does not have the grid's shape, or `difference` names an unknown one.
    """
    if not volumes:
        raise ValueError("volumes must hold at least one volume")
    for name, volume in volumes.items():
        if tuple(volume.shape) != tuple(grid.shape):
            raise ValueError(
                f"volume {name!r} must have the grid's shape {tuple(grid.shape)}, got {tuple(volume.shape)}"
            )
    if difference is not None and not set(difference) <= set(volumes):
        raise ValueError(f"difference must name two of {', '.join(volumes)}, got {difference}")
    first = next(iter(volumes.values()))
    low, high = window or tuple(float(q) for q in np.percentile(first.detach().cpu().numpy(), [1.0, 99.5]))
    columns = len(volumes) + (difference is not None)
    rows = len(heights_mm) + (profile_y_mm is not None)
    figure = Figure(
        figsize=(2.6 * columns + 0.5, 2.6 * rows + 0.3), layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03)
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    extent = _extent(grid)
    for row, height in enumerate(heights_mm):
        k = _index(height, grid.origin[2], grid.spacing[2], grid.shape[0])
        outline = None if metal is None else metal[k].detach().cpu().numpy()
        for column, (name, volume) in enumerate(volumes.items()):
            axis = axes[row, column]
            axis.imshow(
                volume[k].detach().cpu().numpy(), cmap="gray", vmin=low, vmax=high, origin="lower", extent=extent
            )
            axis.set_title(name if row == 0 else "", fontsize=10)
            if outline is not None and outline.max() > 0.5 and outline.min() < 0.5:
                axis.contour(outline, levels=[0.5], colors="yellow", linewidths=0.5, extent=extent, origin="lower")
        if difference is not None:
            change = (volumes[difference[0]][k] - volumes[difference[1]][k]).detach().cpu().numpy()
            reach = (high - low) / 4
            axis = axes[row, -1]
            axis.imshow(change, cmap="RdBu_r", vmin=-reach, vmax=reach, origin="lower", extent=extent)
            axis.set_title(f"{difference[0]} - {difference[1]}" if row == 0 else "", fontsize=10)
        axes[row, 0].set_ylabel(f"z = {grid.origin[2] + k * grid.spacing[2]:.0f} mm", fontsize=9)
    for axis in axes[: len(heights_mm)].flat:
        axis.set(xticks=[], yticks=[])
    if profile_y_mm is not None:
        _profiles(figure, axes, volumes, grid, heights_mm[-1], profile_y_mm, (low, high), unit)
    return figure


def _profiles(figure, axes, volumes, grid, height, y_mm, window, unit) -> None:
    for axis in axes[-1]:
        axis.remove()
    axis = figure.add_subplot(axes[-1, 0].get_gridspec()[-1, :])
    k = _index(height, grid.origin[2], grid.spacing[2], grid.shape[0])
    j = _index(y_mm, grid.origin[1], grid.spacing[1], grid.shape[1])
    x = grid.origin[0] + grid.spacing[0] * np.arange(grid.shape[2])
    for (name, volume), colour in zip(volumes.items(), _COLOURS * len(volumes)):
        axis.plot(x, volume[k, j].detach().cpu().numpy(), label=name, color=colour, linewidth=1.1)
    margin = 0.3 * (window[1] - window[0])
    axis.set(
        xlabel=f"x (mm) at y = {y_mm:g}, z = {height:g}", ylabel=unit, ylim=(window[0] - margin, window[1] + margin)
    )
    axis.legend(fontsize=8, ncols=len(volumes), frameon=False)


def _extent(grid: VolumeGrid) -> tuple[float, float, float, float]:
    x, y = grid.origin[:2]
    width, height = grid.size_mm[:2]
    left, bottom = x - grid.spacing[0] / 2, y - grid.spacing[1] / 2
    return (left, left + width, bottom, bottom + height)


def _index(position: float, origin: float, spacing: float, count: int) -> int:
    return int(np.clip(round((position - origin) / spacing), 0, count - 1))


def beam_figure(beam: Beam, names: Sequence[str], lengths_mm: Tensor, measured: Tensor) -> Figure:
    """A figure of transmission over thickness for each metal, with the pixels that it was estimated from.

    The pixels are shown in up to ten groups of thickness: medians, with 16 % and 84 % quantiles as error bars.

    Args:
        beam: The estimated beam, with the attenuation of the metals.
        names: Names of the metals.
        lengths_mm: Path lengths (M, N) of the pixels in each metal, mm.
        measured: Measured transmissions (N,) of the pixels, without the background.
    """
    figure = new_figure(5.2, 3.6)
    axes = figure.subplots()
    total = lengths_mm.sum(0)
    longest = float(total.max())
    for row, (name, colour) in enumerate(zip(names, COLOURS * len(names))):
        single_metal = lengths_mm[row] > _LEAST_SHARE * total
        line = torch.linspace(0, longest, 100, dtype=torch.float64, device="cpu")
        paths = torch.zeros(1, len(names), 1, 1, len(line), dtype=torch.float64, device="cpu")
        paths[0, row, 0, 0] = line
        axes.plot(line, beam.transmission(paths)[0, 0, 0], color=colour, label=name)
        if int(single_metal.sum()) < 20:
            continue
        lengths, values = lengths_mm[row][single_metal].cpu().numpy(), measured[single_metal].cpu().numpy()
        groups = np.array_split(np.argsort(lengths), min(10, len(lengths) // 10))
        middle = [float(np.median(values[g])) for g in groups]
        low, high = ([float(np.percentile(values[g], q)) for g in groups] for q in (16, 84))
        error = np.abs(np.array([low, high]) - np.array(middle))
        median_lengths = [float(np.median(lengths[g])) for g in groups]
        axes.errorbar(median_lengths, middle, yerr=error, fmt="o", markersize=3, color=colour, linewidth=1)
    axes.set(yscale="log", xlabel="thickness (mm)", ylabel="transmission", ylim=(1e-3, 1.3))
    open_frame(axes)
    axes.legend(frameon=False)
    return figure

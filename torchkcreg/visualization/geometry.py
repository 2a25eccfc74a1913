"""Figure of a scan's geometry in 3D: focal spots, detectors and the implant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, DetectorFrames

from .style import AMBER, BLUE, COLOURS, GREEN, GREY, RED, new_figure

MOST_LABELS = 16
_POINTS = 1500


def geometry_figure(
    geometry: ConeBeamGeometry,
    *,
    points: Tensor | None = None,
    labels: Sequence[str] | None = None,
    title: str = "",
    view_from: tuple[float, float] = (24.0, -52.0),
) -> Figure:
    """A figure of focal spots and detectors in the world, with the directions of columns and rows.

    Args:
        geometry: Geometry of the views. Focal spots are coloured by its `sources`.
        points: Points (N, 3) of an implant in the world, mm.
        labels: Labels of the views; their angles if None. More than sixteen views are not labelled.
        title: Title of the figure.
        view_from: Elevation and azimuth of the viewpoint, degrees.
    """
    frames = DetectorFrames.of(geometry)
    sources, centers = frames.sources.cpu().numpy(), frames.centers.cpu().numpy()
    half = [
        (step.cpu().numpy() * (count / 2))
        for step, count in zip((frames.col_steps, frames.row_steps), reversed(geometry.det_shape), strict=True)
    ]
    figure = new_figure(7.2, 6.2)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    axes.view_init(*view_from)
    names = sorted(set(geometry.sources)) if geometry.sources is not None else [""]
    for view in range(geometry.num_views):
        across, down = half[0][view], half[1][view]
        corners = [centers[view] + a * across + b * down for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        outline = np.stack([*corners, corners[0]])
        axes.plot(*outline.T, color=GREY, linewidth=0.8, alpha=0.6)
        if geometry.num_views <= MOST_LABELS:
            for corner in corners:
                axes.plot(*np.stack([sources[view], corner]).T, color=GREY, linewidth=0.3, alpha=0.35)
    for number, name in enumerate(names):
        spot_views = [
            v for v in range(geometry.num_views) if not name or (geometry.sources and geometry.sources[v] == name)
        ]
        axes.scatter(
            *sources[spot_views].T, s=22, color=COLOURS[number % len(COLOURS)], label=f"focal spot {name}".strip()
        )
    first = centers[0] - half[0][0] - half[1][0]  # the corner of pixel (0, 0) of view 0
    for direction, colour, word in ((half[0][0], AMBER, "columns, u"), (half[1][0], GREEN, "rows, v")):
        axes.quiver(*first, *(2 * direction), color=colour, linewidth=2.2, arrow_length_ratio=0.08)
        axes.text(*(first + 1.2 * direction), word, color=colour, fontsize=9)
    reach = 0.35 * float(np.linalg.norm(sources, axis=1).max())
    for axis, letter in enumerate("xyz"):
        tip = np.eye(3)[axis] * reach
        axes.quiver(0, 0, 0, *tip, color=RED, linewidth=1.5, arrow_length_ratio=0.12)
        axes.text(*(1.12 * tip), letter, color=RED, fontsize=10)
    if points is not None:
        cloud = points.detach().cpu().double().numpy()
        shown = cloud[:: max(1, len(cloud) // _POINTS)]
        axes.scatter(*shown.T, s=1.5, color=BLUE, label="implant")
    for view, word in enumerate(_labels(geometry, labels)):
        axes.text(*(1.08 * sources[view]), word, fontsize=7, color="0.25", ha="center")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)", title=title)
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    return figure


def _labels(geometry: ConeBeamGeometry, labels: Sequence[str] | None) -> Sequence[str]:
    if geometry.num_views > MOST_LABELS:
        return []
    if labels is not None:
        return labels
    if geometry.angles_deg is None:
        return [str(view) for view in range(geometry.num_views)]
    return [f"{angle:g}°" for angle in geometry.angles_deg]

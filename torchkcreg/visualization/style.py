"""Common style of all figures: colour-blind safe colours (Okabe and Ito), white background, open frames."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, AMBER, GREEN, RED, PINK, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
GREY = "0.45"
COLOURS = (BLUE, AMBER, GREEN, RED, PINK, SKY)


def new_figure(width_in: float, height_in: float, **options: Any) -> Figure:
    """An empty figure of a size in inches; `options` are passed to matplotlib's `Figure`."""
    return Figure(**{"figsize": (width_in, height_in), "layout": "constrained", "facecolor": "white", **options})


def open_frame(axes: Axes) -> None:
    """Remove the upper and right edge of the frame."""
    axes.spines[["top", "right"]].set_visible(False)

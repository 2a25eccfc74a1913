"""One look for all figures: colours that the colour-blind tell apart (Okabe and Ito), white ground, open frames."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, AMBER, GREEN, RED, PINK, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
GREY = "0.45"
COLOURS = (BLUE, AMBER, GREEN, RED, PINK, SKY)


def new_figure(width_in: float, height_in: float, **how: Any) -> Figure:
    """An empty figure of a size in inches; `how` as of matplotlib's `Figure`."""
    return Figure(**{"figsize": (width_in, height_in), "layout": "constrained", "facecolor": "white", **how})


def open_frame(axes: Axes) -> None:
    """Takes the frame's upper and right edge away."""
    axes.spines[["top", "right"]].set_visible(False)

"""Figure of a simulated case: some of its views side by side."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry

from .style import new_figure

_MOST = 6
_BRIGHTEST = 0.998  # dead pixels are brighter


def case_figure(line_integrals: Tensor, geometry: ConeBeamGeometry, *, title: str) -> Figure:
    """A figure of up to six views, evenly spaced from the first to the last.

    Args:
        line_integrals: Line integrals (V, rows, cols).
        geometry: Geometry of the views.
        title: Title of the figure.
    """
    number = len(line_integrals)
    shown = sorted({round(i * (number - 1) / max(min(number, _MOST) - 1, 1)) for i in range(min(number, _MOST))})
    rows, cols = line_integrals.shape[1:]
    width = 1.9
    figure = new_figure(width * len(shown), min(width * rows / cols, 8.0) + 0.6)
    figure.suptitle(title)
    for axes, view in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        image = line_integrals[view].numpy()
        axes.imshow(image, cmap="gray_r", origin="lower", vmin=0.0, vmax=float(np.quantile(image, _BRIGHTEST)))
        label = f"view {view}"
        if geometry.sources is not None and geometry.angles_deg is not None:
            label = f"{geometry.sources[view]}, {float(geometry.angles_deg[view]):.0f}°"
        axes.set_title(label, fontsize=8)
        axes.set_axis_off()
    return figure

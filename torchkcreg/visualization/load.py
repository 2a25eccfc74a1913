"""Figure of the load on an implant: moments along it, and the stress on its surface."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.mechanics import CarriedLoad

from .style import AMBER, BLUE, GREEN, new_figure, open_frame

_MOMENTS = {
    3: ("out-of-plane bending", BLUE),
    4: ("in-plane bending", AMBER),
    5: ("torsion", GREEN),
}


def load_figure(
    carried: CarriedLoad, points: Tensor, stress: Tensor, *, yield_stress: float | None = None, title: str | None = None
) -> Figure:
    """A figure of moments along an implant, with a band of one standard deviation, and von Mises stress on both sides.

    Args:
        carried: Load carried by the implant.
        points: Points (P, 3) of the implant's surface in its frame, mm.
        stress: Von Mises stress (P,) at the points, N/mm^2.
        yield_stress: Yield stress of the alloy, N/mm^2.
        title: Title of the figure.
    """
    figure = new_figure(9.5, 5.6)
    top, *rows = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 1, 1]})
    height = carried.heights.cpu().numpy()
    for component, (name, colour) in _MOMENTS.items():
        moment, std = (
            x[:, component].detach().cpu().numpy() / 1000 for x in (carried.section_loads, carried.section_std)
        )
        top.fill_between(height, moment - std, moment + std, color=colour, alpha=0.2, linewidth=0)
        top.plot(height, moment, color=colour, label=name)
    for place in carried.hold_heights.tolist():
        top.axvline(place, color="0.85", linewidth=0.8, zorder=0)
    top.axhline(0, color="0.6", linewidth=0.8, zorder=0)
    top.set_ylabel("moment (N m)")
    top.legend(frameon=False, fontsize=9)
    if title:
        top.set_title(title, fontsize=11)
    local = (points.double() @ carried.axes.mT).cpu().numpy()
    along, across, out = local[:, 2] - local[:, 2].min(), local[:, 0], local[:, 1]
    values, limit = stress.cpu().numpy(), float(np.quantile(stress.cpu().numpy(), 0.995))
    for axes, side, name in zip(rows, (1, -1), ("front", "back"), strict=True):
        seen = side * (out - np.median(out)) >= 0
        order = np.argsort(side * out[seen])
        dots = axes.scatter(
            along[seen][order], across[seen][order], c=values[seen][order], s=3, cmap="viridis", vmin=0, vmax=limit
        )
        axes.set_aspect("equal")
        axes.set_ylabel(f"{name}\n(mm)")
        open_frame(axes)
    rows[-1].set_xlabel("position along the implant (mm); grey lines: possible fixation points")
    yield_text = "" if yield_stress is None else f"; yield {yield_stress:.0f}"
    figure.colorbar(dots, ax=rows, label=f"von Mises\n(MPa{yield_text})", shrink=0.9, pad=0.01, aspect=10, extend="max")
    return figure

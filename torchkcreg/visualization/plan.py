"""Figure of planned views: expected error over the number of views, and gantry angles of the best sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.registration import PlannedSet

from .style import COLOURS, new_figure, open_frame


def plan_figure(
    best: Mapping[int, Sequence[PlannedSet]],
    random: Mapping[int, Tensor],
    *,
    shown: Sequence[PlannedSet],
    labels: Sequence[Sequence[str]],
    angles_deg: Sequence[float] | None = None,
) -> Figure:
    """A figure of the expected errors of the best and of random sets of views.

    If gantry angles are given, the directions of some sets are drawn too.

    Args:
        best: Planned sets by number of views, best first.
        random: Expected errors (S,) of random sets by number of views, mm.
        shown: Sets whose directions are drawn, all with the same number of views.
        labels: Labels of the views of each set in `shown`.
        angles_deg: Gantry angles of all candidate views, degrees.
    """
    figure = new_figure(9.5, 4.2)
    left = figure.add_subplot(1, 2, 1)
    numbers = list(best)
    for low, high, shade in ((0.05, 0.95, 0.25), (0.25, 0.75, 0.4)):
        below, above = ([float(random[n].double().quantile(q)) for n in numbers] for q in (low, high))
        left.fill_between(numbers, below, above, color="0.6", alpha=shade, linewidth=0)
    left.plot(
        numbers,
        [float(random[n].median()) for n in numbers],
        color="0.4",
        label="random views: median, 50 % and 90 % bands",
    )
    left.plot(numbers, [best[n][0].node_std_mm for n in numbers], "o-", color=COLOURS[0], label="best views")
    left.set(xlabel="number of views", ylabel="expected error of the nodes (mm)", xticks=numbers, yscale="log")
    left.set_yticks([t for t in (0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0) if _inside(t, left.get_ylim())])
    left.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    left.yaxis.set_minor_formatter("")
    left.legend(frameon=False, fontsize=9)
    open_frame(left)
    if angles_deg is not None:
        right = figure.add_subplot(1, 2, 2, projection="polar")
        for rank, (planned_set, words, colour) in enumerate(zip(shown, labels, COLOURS, strict=False)):
            angles = np.radians([angles_deg[view] for view in planned_set.views])
            radius = 1 - 0.12 * rank
            right.scatter(angles, np.full(len(angles), radius), color=colour, label=f"{planned_set.node_std_mm:.3f} mm")
            if rank == 0:
                for angle, word in zip(angles, words, strict=True):
                    right.annotate(word, (angle, radius), (0, 8), textcoords="offset points", ha="center", fontsize=8)
        right.set(ylim=(0, 1.2), yticks=[])
        right.set_title(f"gantry angles of the best sets of {len(shown[0].views)}", fontsize=11)
        right.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.08, 1.0), title="expected error")
    return figure


def _inside(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]

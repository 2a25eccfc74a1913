"""How an implant bent in each of several configurations, side by side on one colour scale (fig. 3B of the paper)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.geometry import principal_axes

from .displacement import COLOUR_MAP
from .style import new_figure

_EXAGGERATIONS = (20.0, 10.0, 5.0, 2.0, 1.0)
_DRAWN_SHARE = 0.1  # of the implant's length: as far as the largest displacement is drawn
_HEIGHT_IN, _WIDTH_IN = 5.5, 1.25


def series_figure(panels: Mapping[str, tuple[Tensor, Tensor]], *, label: str) -> Figure:
    """A figure of an implant from its edge, a panel a configuration, the undeformed one in grey.

    Args:
        panels: Undeformed nodes (N, 3) in the world and their displacements (N, 3), mm, by the panels' titles.
        label: Of the colour bar.

    Raises:
        ValueError: If there is no panel.
    """
    if not panels:
        raise ValueError("there is nothing to draw")
    lengths = {name: vectors.norm(dim=1).numpy() for name, (_, vectors) in panels.items()}
    largest = max(float(length.max()) for length in lengths.values())
    norm = Normalize(0.0, max(largest, 1e-9))
    figure = new_figure(_WIDTH_IN * len(panels) + 1.4, _HEIGHT_IN)
    columns = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (name, (nodes, vectors)) in zip(columns, panels.items(), strict=True):
        _, directions = principal_axes(nodes)
        thin, long = directions[0].numpy(), directions[-1].numpy()
        thin, long = thin * np.sign(thin[np.abs(thin).argmax()]), long * np.sign(long[2] or 1.0)
        size = float(np.ptp(nodes.numpy() @ long))
        times = next((x for x in _EXAGGERATIONS if x * largest <= _DRAWN_SHARE * size), 1.0)
        at, by = (nodes - nodes.mean(0)).numpy(), times * vectors.numpy()
        axes.scatter(at @ thin, at @ long, s=1, c="0.8", linewidths=0)
        axes.scatter((at + by) @ thin, (at + by) @ long, s=1, c=lengths[name], cmap=COLOUR_MAP, norm=norm, linewidths=0)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(f"{name}\n{lengths[name].max():.2f} mm", fontsize=9)
    figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=list(columns), label=label, shrink=0.7)
    figure.suptitle(f"displacements drawn {times:g} times as large", fontsize=9)
    return figure

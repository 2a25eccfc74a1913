"""Capture range: the share of starts that a registration brings home, over how far they were off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from .style import COLOURS, new_figure, open_frame

_SIZES = (10, 7, 5, 3)  # equal shares stay visible behind each other


def capture_figure(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    *,
    required: tuple[float, float] | None = None,
    captured_mm: float = 0.2,
) -> Figure:
    """A figure of the captured share against the starts' offset, a curve a name.

    Args:
        curves: name to offsets (mm and degrees) and captured shares, 0 to 1; up to four.
        required: an offset and the share that is asked for there, marked by a cross.
        captured_mm: the error that counts as captured, for the label.

    Raises:
        ValueError: there is no curve, more than four, or one whose offsets and shares differ in number.
    """
    if not 0 < len(curves) <= len(_SIZES):
        raise ValueError(f"there must be one to {len(_SIZES)} curves, got {len(curves)}")
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    for (name, (offsets, shares)), colour, size in zip(curves.items(), COLOURS, _SIZES):
        if len(offsets) != len(shares) or not offsets:
            raise ValueError(f"curve {name!r} has {len(offsets)} offsets and {len(shares)} shares")
        axes.plot(offsets, shares, "o-", color=colour, markersize=size, label=name, clip_on=False, zorder=3)
    if required is not None:
        offset, share = required
        axes.plot([offset], [share], "x", color="0.2", markersize=9, label=f"asked for: {share:.0%} at {offset:g}")
    axes.set(xlim=(0, None), ylim=(0, 1.05))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("start off by (mm and degrees)")
    axes.set_ylabel(f"end below {captured_mm:g} mm rigid error")
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    open_frame(axes)
    return figure

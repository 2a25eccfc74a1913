"""What metal lets through by its thickness: measured, and by the beam that was estimated from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.physics import Beam

from .style import COLOURS, new_figure, open_frame

_LEAST_SHARE = 0.98  # of a pixel's metal: what is drawn for one metal has next to nothing of the others


def beam_figure(beam: Beam, names: Sequence[str], lengths_mm: Tensor, measured: Tensor) -> Figure:
    """Transmission over thickness of each metal, with the pixels it was estimated from, ten quantiles at a time.

    Args:
        beam: As estimated, with the attenuation of the metals.
        names: Of the metals.
        lengths_mm: Path lengths (M, N) of the pixels.
        measured: Their transmissions (N,) without the background's.
    """
    figure = new_figure(5.2, 3.6)
    axes = figure.subplots()
    total = lengths_mm.sum(0)
    longest = float(total.max())
    for row, (name, colour) in enumerate(zip(names, COLOURS * len(names))):
        own = lengths_mm[row] > _LEAST_SHARE * total
        line = torch.linspace(0, longest, 100, dtype=torch.float64, device="cpu")
        paths = torch.zeros(1, len(names), 1, 1, len(line), dtype=torch.float64, device="cpu")
        paths[0, row, 0, 0] = line
        axes.plot(line, beam.transmission(paths)[0, 0, 0], color=colour, label=name)
        if int(own.sum()) < 20:
            continue
        lengths, values = lengths_mm[row][own].cpu().numpy(), measured[own].cpu().numpy()
        groups = np.array_split(np.argsort(lengths), min(10, len(lengths) // 10))
        middle = [float(np.median(values[g])) for g in groups]
        low, high = ([float(np.percentile(values[g], q)) for g in groups] for q in (16, 84))
        error = np.abs(np.array([low, high]) - np.array(middle))
        at = [float(np.median(lengths[g])) for g in groups]
        axes.errorbar(at, middle, yerr=error, fmt="o", markersize=3, color=colour, linewidth=1)
    axes.set(yscale="log", xlabel="thickness, mm", ylabel="transmission", ylim=(1e-3, 1.3))
    open_frame(axes)
    axes.legend(frameon=False)
    return figure

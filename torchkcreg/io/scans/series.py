"""Image series: views that are read on demand, with open beam, dark field and header."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .plausible import ImageHeader


def by_number(file: Path) -> list[tuple[int, str]]:
    """Sort key for file names with numbers: view_2 comes before view_10.

    >>> [path.name for path in sorted([Path("v10.tif"), Path("v2.tif")], key=by_number)]
    ['v2.tif', 'v10.tif']
    """
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", file.name.lower())]


@dataclass(frozen=True)
class ImageSeries:
    """Images of views that are read on demand.

    Attributes:
        num_views: Number of views.
        read: Function that returns the stored images (v, rows, cols) of a list of views.
        beside: Further data: "open_beam" and "dark", each a number or an image (rows, cols), and "saturation".
        header: Pixel spacing and axes from the file; None if it gives none.
        lines: True for line integrals, False for intensities, None if not stated.
    """

    num_views: int
    read: Callable[[Sequence[int]], NDArray]
    beside: dict[str, NDArray] = field(default_factory=dict)
    header: ImageHeader | None = None
    lines: bool | None = None

    def arrays(self, views: Sequence[int]) -> dict[str, NDArray]:
        """Images of the given views and the data in `beside`, by name. Images of unstated kind are named "image"."""
        kind = {None: "image", True: "line_integrals", False: "intensity"}[self.lines]
        return {kind: self.read(views), **self.beside}

    def mean(self, views: Sequence[int]) -> NDArray:
        """Mean image (rows, cols) of the given views, float32. The images are read one at a time."""
        total = self.read([views[0]])[0].astype(np.float64)
        for view in views[1:]:
            total += self.read([view])[0]
        return (total / len(views)).astype(np.float32)

"""Images of views that stay where they are until they are read, and what is said beside them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .plausible import ImageHeader


def by_number(file: Path) -> list[tuple[int, str]]:
    """What to sort by: view_2 before view_10.

    >>> [path.name for path in sorted([Path("v10.tif"), Path("v2.tif")], key=by_number)]
    ['v2.tif', 'v10.tif']
    """
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", file.name.lower())]


@dataclass(frozen=True)
class ImageSeries:
    """Images of views that stay where they are until they are read.

    Attributes:
        num_views: how many there are.
        read: images (v, rows, cols) of a list of views, as they are stored.
        beside: what is said of them: "open_beam", "dark", each a number or an image (rows, cols), "saturation".
        header: what the file says of pixels and axes; None where it says nothing.
        lines: whether they are line integrals, where that is said; None where it is not.
    """

    num_views: int
    read: Callable[[Sequence[int]], NDArray]
    beside: dict[str, NDArray] = field(default_factory=dict)
    header: ImageHeader | None = None
    lines: bool | None = None

    def arrays(self, views: Sequence[int]) -> dict[str, NDArray]:
        """Images of the given views and what is said of them, by name; images of no stated kind are the "image"."""
        kind = {None: "image", True: "line_integrals", False: "intensity"}[self.lines]
        return {kind: self.read(views), **self.beside}

    def mean(self, views: Sequence[int]) -> NDArray:
        """The mean (rows, cols) of some of the images, float32; they are read one by one."""
        total = self.read([views[0]])[0].astype(np.float64)
        for view in views[1:]:
            total += self.read([view])[0]
        return (total / len(views)).astype(np.float32)

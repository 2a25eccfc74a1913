"""Image series: views that are read on demand, with open beam, dark field and header."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .plausible import ImageHeader


def in_order(files: Iterable[Path]) -> list[Path]:
    """Files in the order of the numbers in their names: view_2 before view_10, p_-1 before p_0, p_0.25 before p_0.5.

    A dash is a minus if it follows a blank, a bracket, `_`, `=` or nothing, or if other names have no dash in its
    place. A point between digits is a decimal point, unless a name has several in a row. If numbers around a point
    could also be counted each for itself and the order would then differ, there is a warning.

    >>> [path.name for path in in_order([Path("v10.tif"), Path("v2.tif"), Path("v-1.tif")])]
    ['v-1.tif', 'v2.tif', 'v10.tif']
    """
    stems = {file: _stem(file) for file in files}
    bare = {_DIGITS.sub("#", stem) for stem in stems.values()}
    decimal, separate = (
        {
            file: [_part(text, stem, start, bare) for text, start in _parts(pattern, stem)]
            for file, stem in stems.items()
        }
        for pattern in (_DECIMAL, _SIGNED)
    )
    order = sorted(stems, key=decimal.__getitem__)
    has_minus = any(-math.inf < value < 0 for parts in decimal.values() for value, _ in parts)
    if not has_minus and order != sorted(stems, key=separate.__getitem__):
        shown = ", ".join(file.name for file in order[:4])
        warnings.warn(f"points in the names of the views are read as decimal points: {shown}, ...", stacklevel=2)
    return order


_DIGITS = re.compile(r"\d+")
_SIGNED = re.compile(r"-?\d+")
_DECIMAL = re.compile(r"-?(?:\d+(?:\.\d+){2,}|\d+\.\d+|\d+)")  # 1.2.3 is no number, but three
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_BEFORE_A_SIGN = " _=([{,;"


def _stem(file: Path) -> str:
    name = file.name.lower()
    return re.sub(r"(\.[a-z]\w*)+$", "", name)  # without suffixes such as .nii.gz


def _parts(pattern: re.Pattern[str], stem: str) -> Iterator[tuple[str, int]]:
    """Texts and numbers of a name, and where they start."""
    end = 0
    for match in pattern.finditer(stem):
        pieces = [match] if _NUMBER.fullmatch(match[0]) else list(_DIGITS.finditer(stem, *match.span()))
        for piece in pieces:
            if piece.start() > end:
                yield stem[end : piece.start()], end
            yield piece[0], piece.start()
            end = piece.end()
    if end < len(stem):
        yield stem[end:], end


def _part(text: str, stem: str, start: int, bare: set[str]) -> tuple[float, str]:
    if not _NUMBER.fullmatch(text):
        return (-math.inf, text)
    if not text.startswith("-"):
        return (float(text), "")
    before = stem[start - 1] if start else ""
    without = _DIGITS.sub("#", stem[:start] + stem[start + 1 :])
    is_minus = before in _BEFORE_A_SIGN or (without in bare and not before.isdigit())
    return (float(text) if is_minus else float(text[1:]), "")


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

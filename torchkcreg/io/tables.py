"""Tables of numbers as text: columns between commas, semicolons or blanks, comments after #, maybe a header line."""

from __future__ import annotations

import math
import os
import re

import numpy as np
from numpy.typing import NDArray

from torchkcreg.io.files import read_text

_SEPARATOR = re.compile(r"\s*[,;\t]\s*|\s+")


def read_table(path: str | os.PathLike[str], what: str, names: tuple[str, ...]) -> NDArray[np.float64]:
    """The first columns of a text table as an array (rows, len(names)); further columns are ignored.

    The first line that is no comment may be a header, which is skipped.

    Args:
        path: the file.
        what: what it is, for messages ("points", "spectrum").
        names: what its columns hold, for messages.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line has too few columns or something that is no finite number, or there is no row at all; the
            message names the line.
    """
    rows: list[list[float]] = []
    header_may_follow = True
    for number, line in enumerate(read_text(path, what).splitlines(), start=1):
        line = line.split("#", 1)[0].strip()
        if not line:
            continue
        cells = [cell for cell in _SEPARATOR.split(line) if cell]
        values = [_number(cell) for cell in cells[: len(names)]]
        if header_may_follow and values and all(value is None for value in values):
            header_may_follow = False
            continue
        header_may_follow = False
        if len(values) < len(names) or any(value is None or not math.isfinite(value) for value in values):
            raise ValueError(
                f"{what} file {path}, line {number}: expected numbers {', '.join(names)}, got {line[:60]!r}"
            )
        rows.append([value for value in values if value is not None])
    if not rows:
        raise ValueError(f"{what} file {path} holds no rows of {', '.join(names)}")
    return np.array(rows, dtype=np.float64)


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None

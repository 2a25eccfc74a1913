"""Tables of numbers as text: separator and decimal sign are recognised, names of columns count, doubts are refused."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchkcreg.io.files import read_text

_UNITS = {"um", "µm", "mm", "cm", "m", "in", "inch", "ev", "kev", "mev"}
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?", re.ASCII)
_READINGS = [(";", _POINT), (";", _COMMA), ("\t", _POINT), ("\t", _COMMA), (",", _POINT), (",", _COMMA)]
_READINGS += [("", _POINT), ("", _COMMA)]  # blanks
_Rows = list[tuple[int, list[str]]]


class _Refused(ValueError):
    """No table in this reading, for a reason that shows in a line."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(f", line {line}: {why}" if line else f" {why}")
        self.line = line


@dataclass(frozen=True)
class Column:
    """A column that is wanted.

    Attributes:
        name: How messages, and most files, call it.
        unit: The one it is in; a header that says another is refused.
        others: Further names it goes by.
        any_name: Where one column is left, it is this one, whatever its name.
    """

    name: str
    unit: str = ""
    others: tuple[str, ...] = ()
    any_name: bool = False


def read_table(path: str | os.PathLike[str], what: str, columns: Sequence[Column]) -> NDArray[np.float64]:
    """Columns of a text table as an array (rows, len(columns)).

    Cells stand between commas, semicolons, tabs or blanks, as all lines agree; numbers have points or, but between
    commas, decimal commas. Comments begin with #. If the first line holds names, columns are taken by them, whatever
    stands beside; without names there must be as many columns as are wanted.

    Args:
        path: The file.
        what: What it is, for messages ("points", "spectrum").
        columns: What is wanted of it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: Names or a unit are others, a line has more or fewer columns than the first, separators or decimal
            signs change, or a cell is empty or no finite number; the message names file and line.
    """
    texts = enumerate(read_text(path, what).splitlines(), start=1)
    lines = [(n, text) for n, line in texts if (text := line.split("#", 1)[0].strip(" \r")).strip()]
    try:
        return _parse(lines, columns)
    except ValueError as error:
        raise ValueError(f"{what} file {path}{error}") from None


def _parse(lines: list[tuple[int, str]], columns: Sequence[Column]) -> NDArray[np.float64]:
    if not lines:
        raise _Refused(0, f"holds no rows of {', '.join(c.name for c in columns)}")
    failures = []
    for separator, number in _READINGS:
        if not any((separator or " ") in text.replace("\t", " \t") for _, text in lines):
            continue
        try:
            rows = [(line, _split(line, text, separator)) for line, text in lines]
            return _numbers(rows, number, columns)  # no other reading would do: no number holds a separator
        except _Refused as failure:
            failures.append(failure)
    if not failures:
        raise _Refused(lines[0][0], f"expected {len(columns)} columns, got {lines[0][1][:60]!r}")
    raise max(failures, key=lambda failure: failure.line)  # what could be read furthest; of equals the first


def _split(line: int, text: str, separator: str) -> list[str]:
    if not separator:
        return text.split()
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]
    except csv.Error as error:
        raise _Refused(line, str(error)) from None


def _numbers(rows: _Rows, number: re.Pattern[str], columns: Sequence[Column]) -> NDArray[np.float64]:
    """The wanted columns in one reading of the cells."""
    wanted = ", ".join(c.name for c in columns)
    titled = not any(_POINT.fullmatch(cell) or _COMMA.fullmatch(cell) for cell in rows[0][1])
    body = rows[titled:]
    if not body:
        raise _Refused(0, f"holds no rows of {wanted}")
    while all(len(cells) > len(columns) and not cells[-1] for _, cells in rows):
        rows = [(line, cells[:-1]) for line, cells in rows]
        body = rows[titled:]
    line, first = rows[0]
    if not titled and len(first) != len(columns):
        more = ": name the columns in a first line" if len(first) > len(columns) else ""
        raise _Refused(line, f"expected numbers {wanted}, got {len(first)} columns{more}")
    places = _places(line, first, columns) if titled else range(len(columns))
    table = []
    for line, cells in body:
        if len(cells) != len(first):
            raise _Refused(line, f"expected numbers {wanted} in {len(first)} columns, got {len(cells)} columns")
        chosen = [cells[place] for place in places]
        for column, cell in zip(columns, chosen):
            if not number.fullmatch(cell) or not np.isfinite(float(cell.replace(",", "."))):
                raise _Refused(line, f"expected numbers {wanted}, got {cell[:40]!r} as {column.name}")
        table.append([float(cell.replace(",", ".")) for cell in chosen])
    return np.array(table, dtype=np.float64)


def _places(line: int, titles: list[str], columns: Sequence[Column]) -> list[int]:
    """Where the wanted columns stand by their names."""
    names, units = zip(*map(_name_and_unit, titles))
    left = list(range(len(titles)))
    places = []
    for column in columns:
        known = {column.name, *column.others}
        found = [
            i for i in left if names[i] in known or (not names[i] and column.unit and units[i] == column.unit.lower())
        ]
        if not found and column.any_name and len(left) == 1:
            found = left
        if len(found) != 1:
            what = "no column" if not found else f"{len(found)} columns"
            raise _Refused(line, f"expected columns {', '.join(c.name for c in columns)}, got {what} {column.name}")
        if units[found[0]] and units[found[0]] != column.unit.lower():
            raise _Refused(line, f"column {titles[found[0]]!r} must be in {column.unit or 'no unit'}")
        places.append(found[0])
        left = [i for i in left if i != found[0]]
    return places


def _name_and_unit(title: str) -> tuple[str, str]:
    words = re.findall(r"[^\W\d_]+\d*", title.lower())
    units = [word for word in words if word in _UNITS]
    return " ".join(word for word in words if word not in _UNITS), units[0] if units else ""

"""Tables of numbers as text: separator and decimal sign are recognised, names of columns count, doubts are refused."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchkcreg.physics import Spectrum

from .files import read_text, write_text

_UNITS = {"um", "µm", "mm", "cm", "m", "in", "inch", "ev", "kev", "mev"}
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?", re.ASCII)
_READINGS = [(";", _POINT), (";", _COMMA), ("\t", _POINT), ("\t", _COMMA), (",", _POINT), (",", _COMMA)]
_READINGS += [("", _POINT), ("", _COMMA)]  # blanks
_LARGEST_KEV = 1000.0
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


_COLUMNS = [
    Column("energy", "keV", ("e", "energies", "photon energy")),
    Column("weight", "", ("weights", "detected weight", "detected energy weight", "counts", "fluence"), any_name=True),
]
_XYZ = [Column(axis, "mm") for axis in "xyz"]


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


def write_rows(path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV, a column a key; a row without a key leaves its cell empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_points(path: str | os.PathLike[str]) -> Tensor:
    """Points (N, 3) float64 in mm from a text table: columns named x, y, z, or three columns without names.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such table, see `torchkcreg.io.tables.read_table`; the message names the line.
    """
    return torch.from_numpy(read_table(path, "points", _XYZ))


def write_points(path: str | os.PathLike[str], points: Tensor, **columns: Tensor) -> None:
    """Nothing; writes points as CSV with a header line, in the given order, to a millionth of a mm.

    Args:
        path: the file.
        points: (N, 3) in mm.
        **columns: further columns by name, each (N,): flags as 0 and 1, numbers with six decimals.

    Raises:
        ValueError: shapes don't fit, or a point is not finite.
    """
    array = points.detach().cpu().double().numpy()
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"points must be finite, but row {int(np.argmin(np.isfinite(array).all(axis=1)))} is not")
    texts = [[f"{value:.6f}" for value in row] for row in array.tolist()]
    for name, column in columns.items():
        if column.shape != points.shape[:1]:
            raise ValueError(f"column {name} must have shape ({len(points)},), got {tuple(column.shape)}")
        for row, value in zip(texts, column.tolist()):
            row.append(f"{value:.6f}" if isinstance(value, float) else str(int(value)))
    lines = [",".join(["x", "y", "z", *columns]), *(",".join(row) for row in texts)]
    write_text(path, "\n".join(lines) + "\n")


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """The spectrum of a text table: energy in keV and the weight with which the detector counts it (any scale).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: energies are not positive, not rising, or too large for keV; a weight is negative, or all are 0.
    """
    table = read_table(path, "spectrum", _COLUMNS)
    energies, weights = table[:, 0], table[:, 1]
    if energies.min() <= 0 or energies.max() > _LARGEST_KEV:
        raise ValueError(
            f"spectrum file {path}: energies must be in keV, positive and at most {_LARGEST_KEV:g}, "
            f"got {energies.min():g} to {energies.max():g}"
        )
    try:
        return Spectrum(tuple(energies.tolist()), tuple(weights.tolist()))
    except ValueError as error:
        raise ValueError(f"spectrum file {path}: {error}") from error


def write_spectrum(path: str | os.PathLike[str], spectrum: Spectrum) -> None:
    """Nothing; writes a spectrum as `read_spectrum` reads it."""
    rows = [f"{float(e):.6g},{float(w):.9g}" for e, w in zip(spectrum.energies_kev, spectrum.weights)]
    write_text(path, "# energy_keV,detected_weight\n" + "\n".join(rows) + "\n")

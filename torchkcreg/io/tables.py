"""Text tables of numbers, points and spectra. Separator and decimal sign are detected; ambiguous files are rejected."""

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
_READINGS += [("", _POINT), ("", _COMMA)]  # separated by blanks
_LARGEST_KEV = 1000.0
_Rows = list[tuple[int, list[str]]]


class _Refused(ValueError):
    """The table cannot be parsed with the assumed separator and decimal sign; the reason names the line."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(f", line {line}: {why}" if line else f" {why}")
        self.line = line


@dataclass(frozen=True)
class Column:
    """A requested column.

    Attributes:
        name: Name in messages and in most files.
        unit: Unit of the values. A header with another unit is rejected.
        others: Alternative names.
        any_name: If only one column remains unassigned, use it whatever its name.
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

    Cells are separated by commas, semicolons, tabs or blanks, the same in all lines. Numbers have decimal points, or
    decimal commas unless commas separate the cells. Comments begin with #. If the first line holds names, columns are
    selected by name and further columns are ignored. Without names, the number of columns must match.

    Args:
        path: The file.
        what: Kind of file, for messages ("points", "spectrum").
        columns: Requested columns.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: A name or unit does not match, a line has more or fewer columns than the first, separators or
            decimal signs change, or a cell is empty or no finite number. The message names file and line.
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
            return _numbers(rows, number, columns)  # unambiguous: no number contains a separator
        except _Refused as failure:
            failures.append(failure)
    if not failures:
        raise _Refused(lines[0][0], f"expected {len(columns)} columns, got {lines[0][1][:60]!r}")
    raise max(failures, key=lambda failure: failure.line)  # the attempt that got furthest; the first of equals


def _split(line: int, text: str, separator: str) -> list[str]:
    if not separator:
        return text.split()
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]
    except csv.Error as error:
        raise _Refused(line, str(error)) from None


def _numbers(rows: _Rows, number: re.Pattern[str], columns: Sequence[Column]) -> NDArray[np.float64]:
    """The requested columns, with the cells parsed by one number format."""
    column_names = ", ".join(c.name for c in columns)
    titled = not any(_POINT.fullmatch(cell) or _COMMA.fullmatch(cell) for cell in rows[0][1])
    body = rows[titled:]
    if not body:
        raise _Refused(0, f"holds no rows of {column_names}")
    while all(len(cells) > len(columns) and not cells[-1] for _, cells in rows):
        rows = [(line, cells[:-1]) for line, cells in rows]
        body = rows[titled:]
    line, first = rows[0]
    if not titled and len(first) != len(columns):
        more = ": name the columns in a first line" if len(first) > len(columns) else ""
        raise _Refused(line, f"expected numbers {column_names}, got {len(first)} columns{more}")
    places = _places(line, first, columns) if titled else range(len(columns))
    table = []
    for line, cells in body:
        if len(cells) != len(first):
            raise _Refused(line, f"expected numbers {column_names} in {len(first)} columns, got {len(cells)} columns")
        chosen = [cells[place] for place in places]
        for column, cell in zip(columns, chosen):
            if not number.fullmatch(cell) or not np.isfinite(float(cell.replace(",", "."))):
                raise _Refused(line, f"expected numbers {column_names}, got {cell[:40]!r} as {column.name}")
        table.append([float(cell.replace(",", ".")) for cell in chosen])
    return np.array(table, dtype=np.float64)


def _places(line: int, titles: list[str], columns: Sequence[Column]) -> list[int]:
    """Positions of the requested columns, found by name."""
    names, units = zip(*map(_name_and_unit, titles))
    remaining = list(range(len(titles)))
    places = []
    for column in columns:
        known = {column.name, *column.others}
        matches = [
            i
            for i in remaining
            if names[i] in known or (not names[i] and column.unit and units[i] == column.unit.lower())
        ]
        if not matches and column.any_name and len(remaining) == 1:
            matches = remaining
        if len(matches) != 1:
            what = "no column" if not matches else f"{len(matches)} columns"
            raise _Refused(line, f"expected columns {', '.join(c.name for c in columns)}, got {what} {column.name}")
        if units[matches[0]] and units[matches[0]] != column.unit.lower():
            raise _Refused(line, f"column {titles[matches[0]]!r} must be in {column.unit or 'no unit'}")
        places.append(matches[0])
        remaining = [i for i in remaining if i != matches[0]]
    return places


def _name_and_unit(title: str) -> tuple[str, str]:
    words = re.findall(r"[^\W\d_]+\d*", title.lower())
    units = [word for word in words if word in _UNITS]
    return " ".join(word for word in words if word not in _UNITS), units[0] if units else ""


def write_rows(path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV with one column per key. A cell is empty if the row lacks the key."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_points(path: str | os.PathLike[str]) -> Tensor:
    """Read points (N, 3) float64 in mm from a text table: columns named x, y, z, or three columns without names.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is no such table, see `torchkcreg.io.tables.read_table`; the message names the line.
    """
    return torch.from_numpy(read_table(path, "points", _XYZ))


def write_points(path: str | os.PathLike[str], points: Tensor, **columns: Tensor) -> None:
    """Write points as CSV with a header line, in the given order, with six decimals.

    Args:
        path: The file.
        points: (N, 3) in mm.
        **columns: Further columns by name, each (N,): floats with six decimals, flags as 0 and 1.

    Raises:
        ValueError: The shapes do not fit, or a point is not finite.
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


def is_points_table(path: str | os.PathLike[str], column: str) -> bool:
    """True if a file is a table that `write_points` wrote with this first further column."""
    begin = f"x,y,z,{column}".encode()
    with open(path, "rb") as file:
        return file.read(len(begin)) == begin


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """Read a spectrum from a text table: energy in keV and detected weight (arbitrary scale).

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: Energies are not positive, not increasing, or too large for keV; a weight is negative, or all are 0.
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
    """Write a spectrum as a text table for `read_spectrum`."""
    rows = [f"{float(e):.6g},{float(w):.9g}" for e, w in zip(spectrum.energies_kev, spectrum.weights)]
    write_text(path, "# energy_keV,detected_weight\n" + "\n".join(rows) + "\n")

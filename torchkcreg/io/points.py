"""Points as CSV: a header line, then x, y, z in mm, one row a point."""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from torchkcreg.io.files import write_text
from torchkcreg.io.tables import Column, read_table

_XYZ = [Column(axis, "mm") for axis in "xyz"]


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

"""Tables of projection matrices or ASTRA vectors: NPY, NPZ, CSV and TXT."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchkcreg.geometry import ConeBeamGeometry, from_astra, to_astra
from torchkcreg.plain import first_line

from .files import atomic_path, write_text

SUFFIXES = (".npy", ".npz", ".csv", ".txt")
LAYOUTS = ("matrices", "astra")
LARGEST = 1 << 26  # table size in bytes
SPACING_AGREES = 1e-3  # relative


def read_matrix_table(
    path: Path, *, det_shape: Sequence[int], pixel_spacing: Sequence[float], layout: str | None = None
) -> ConeBeamGeometry:
    """The geometry of a table of 3 x 4 matrices or of ASTRA's `cone_vec`.

    Matrices map world mm to 0-based pixels. They are an array (V, 3, 4), three lines of four numbers per view, or one
    line of twelve numbers per view. An NPZ file holds a single array, or the array is named `projection_matrices`.

    Args:
        path: The file.
        det_shape: (rows, cols).
        pixel_spacing: (dv, du), mm.
        layout: Meaning of twelve numbers per view: "matrices" (row by row) or "astra" (source, detector centre,
            column step, row step, in mm). It must be given in that case; it is never guessed.

    Raises:
        ValueError: The file is no such table, or contradicts the pixel spacing.
    """
    if path.stat().st_size > LARGEST:
        raise ValueError(f"is larger than {LARGEST} bytes")
    table = _table(path)
    if table.ndim == 2 and table.shape[1] == 12 and layout not in LAYOUTS:
        raise ValueError(f"twelve numbers a view may be matrices or ASTRA's vectors: say layout {' or '.join(LAYOUTS)}")
    if table.ndim == 2 and table.shape[1] == 4 and len(table) % 3 == 0:
        table = table.reshape(-1, 3, 4)
    if table.size == 0 or table.dtype.kind not in "fiu" or not np.isfinite(table).all():
        raise ValueError("must be finite numbers")
    if table.ndim == 2 and table.shape[1] == 12 and layout == "astra":
        geometry = from_astra(torch.from_numpy(table.astype(np.float64)), det_shape)
        if not np.allclose(geometry.pixel_spacing, pixel_spacing, rtol=SPACING_AGREES):
            raise ValueError(f"its pixels are {geometry.pixel_spacing} mm apart, not {tuple(pixel_spacing)}")
        return geometry
    matrices = table.reshape(-1, 3, 4) if table.shape[1:] in ((12,), (3, 4)) else None
    if matrices is None:
        raise ValueError(f"must be V matrices of 3 x 4, got an array of shape {table.shape}")
    geometry = ConeBeamGeometry(torch.from_numpy(matrices.astype(np.float64)), det_shape, pixel_spacing)
    _ = geometry.detector_distances  # raises if rows and columns are inconsistent
    return geometry


def write_matrix_table(path: Path, geometry: ConeBeamGeometry, *, layout: str = "matrices") -> None:
    """Write matrices (V, 3, 4), or ASTRA's `cone_vec` (V, 12), for `read_matrix_table`."""
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be {' or '.join(LAYOUTS)}, got {layout!r}")
    values = geometry.projection_matrices if layout == "matrices" else to_astra(geometry)
    array = values.detach().cpu().numpy()
    if path.suffix.lower() in (".csv", ".txt"):
        separator = "," if path.suffix.lower() == ".csv" else " "
        flat = array.reshape(-1, array.shape[-1])
        write_text(path, "".join(separator.join(repr(float(x)) for x in line) + "\n" for line in flat))
        return
    with atomic_path(path) as part, open(part, "wb") as file:
        if path.suffix.lower() == ".npy":
            np.save(file, array)
        else:
            names = {"projection_matrices" if layout == "matrices" else "cone_vec": array}
            np.savez(file, **names)  # type: ignore[arg-type]


def _table(path: Path) -> NDArray:
    suffix = path.suffix.lower()
    if suffix in (".csv", ".txt"):
        return np.loadtxt(path, delimiter="," if suffix == ".csv" else None, ndmin=2)
    try:
        if suffix == ".npy":
            return np.array(np.load(path, allow_pickle=False, mmap_mode="r"))  # mapping cannot exceed the file
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > LARGEST:
            raise ValueError(f"unpacks to {unpacked} bytes, more than {LARGEST}")
        with np.load(path, allow_pickle=False) as arrays:
            names = arrays.files
            if "projection_matrices" not in names and len(names) != 1:
                raise ValueError(f"must hold one array, or name it projection_matrices, got {', '.join(names)}")
            return arrays["projection_matrices" if "projection_matrices" in names else names[0]]
    except Exception as error:  # NumPy and zipfile raise various types on a damaged file
        reason = first_line(error)
        raise ValueError(f"cannot be read: {reason[:120]}") from error

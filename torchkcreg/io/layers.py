"""Views with and without the implant, kept for a page that lays one over the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchkcreg.io.files import atomic_path

_NAMES = ("grey", "overlay", "labels")


def write_layers(path: Path, layers: dict[str, Any]) -> None:
    """Nothing; writes "grey" (V, h, w), "overlay" (V, h, w, 3), both uint8, and "labels" (V,) as an NPZ file."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: layers[name] for name in _NAMES})  # type: ignore[arg-type]


def read_layers(path: Path) -> dict[str, Any] | None:
    """What `write_layers` wrote; None where there is nothing, or it is damaged: a page does without."""
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {name: file[name] for name in _NAMES}
    except Exception:  # numpy's, zipfile's and zlib's own
        return None
    shape = held["grey"].shape
    fits = len(shape) == 3 and held["overlay"].shape == (*shape, 3) and held["labels"].shape == shape[:1]
    return held if fits and held["grey"].dtype == held["overlay"].dtype == np.uint8 else None

"""A scan's images, flat and dark fields, described in a few lines of YAML beside them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from torchkcreg.config import Config
from torchkcreg.io.config import read_config

DESCRIPTION_SUFFIXES = (".yaml", ".yml")


class RawHeader(Config):
    """How numbers lie in a file without a header.

    Attributes:
        shape: (views, rows, cols); a flat or dark field of the same scan has as many views as fill its file.
        type: of a number.
        byte_order: of numbers of more than a byte.
        skip_bytes: before the first.
    """

    shape: tuple[int, int, int]
    type: Literal["uint8", "uint16", "int16", "uint32", "int32", "float32", "float64"]
    byte_order: Literal["little", "big"] = "little"
    skip_bytes: int = Field(0, ge=0)

    def mapped(self, path: Path, *, views: bool = True) -> NDArray:
        """The numbers (V, rows, cols) of a file, on the disk; `views` asks for as many as `shape` says.

        Raises:
            ValueError: the file is smaller or larger than that.
        """
        kind = np.dtype(self.type).newbyteorder("<" if self.byte_order == "little" else ">")
        if min(self.shape) < 1:
            raise ValueError(f"raw.shape must be positive, got {self.shape}")
        held, image = path.stat().st_size - self.skip_bytes, math.prod(self.shape[1:]) * kind.itemsize
        number = self.shape[0] if views else max(held // image, 1)
        if held != number * image:
            raise ValueError(
                f"{path.name} holds {held} bytes after the first {self.skip_bytes}, {number} images of "
                f"{self.shape[1]} x {self.shape[2]} {self.type} are {number * image}"
            )
        return np.memmap(path, kind, "r", offset=self.skip_bytes, shape=(number, *self.shape[1:]))


class ScanDescription(Config):
    """What a description may say; places are relative to its folder, and within it.

    Attributes:
        images: file or folder of the views.
        flat: file or folder of images of the open beam, of which the mean is taken.
        dark: file or folder of images without a beam, of which the mean is taken, off views and open beam alike.
        open_beam: one number in place of `flat`; without both, images are line integrals.
        saturation: the detector's ceiling.
        line_integrals: whether images are line integrals; without it, what an open beam says.
        dataset: name within HDF5 files.
        raw: how numbers lie in files without a header.
    """

    images: Path
    flat: Path | None = None
    dark: Path | None = None
    open_beam: float | None = Field(None, gt=0)
    saturation: float | None = Field(None, gt=0)
    line_integrals: bool | None = None
    dataset: str | None = None
    raw: RawHeader | None = None


def read_description(path: Path) -> ScanDescription:
    """A scan's description, whose places exist.

    Raises:
        FileNotFoundError: a place that it names is missing.
        ValueError: unknown keys, wrong values, or a place outside its folder.
    """
    said = ScanDescription.of(read_config(path), f"scan description {path}")
    if said.flat is not None and said.open_beam is not None:
        raise ValueError("flat and open_beam both say how strong the open beam is: name one")
    if said.line_integrals and (said.flat is not None or said.dark is not None or said.open_beam is not None):
        raise ValueError("line integrals need no flat, dark or open_beam")
    if said.dark is not None and said.flat is None and said.open_beam is None:
        raise ValueError("a dark field alone leaves the open beam unknown: name flat or open_beam")
    places = {name: place for name in ("images", "flat", "dark") if (place := getattr(said, name)) is not None}
    return said.model_copy(update={name: _place(path, place) for name, place in places.items()})


def _place(path: Path, name: Path) -> Path:
    """A place that a description at a path names."""
    folder, place = path.parent, path.parent / name
    if not place.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{name} lies outside the description's folder: places are named from there, within it")
    if not place.exists():
        raise FileNotFoundError(f"{name}, which scan description {path} names, does not exist")
    return place

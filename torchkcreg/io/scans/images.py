"""Image files through ITK, their sizes checked against their files before anything is allocated."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from torchkcreg.io.scans.meta_header import META_SUFFIXES, check_meta_header

_MOST_PACKED = 5000  # how many times larger than its file an image can be: deflate and LZW pack less
_SMALLEST = 1 << 16  # bytes: what is not worth the question
_DETACHED = (".mhd", ".nhdr")  # headers whose data are in another file


def read_slices(path: Path, slices: Sequence[int]) -> NDArray:
    """Slices of a volume, in this order, without reading the others where the format allows: uncompressed ones.

    Raises:
        RuntimeError: It cannot be read, or its header asks for more than the file can hold.
        ValueError: It holds more than one number a pixel.
    """
    reader = opened(path)
    if reader.GetNumberOfComponents() != 1:
        raise ValueError(f"it has {reader.GetNumberOfComponents()} numbers a pixel: grey images have one")
    cols, rows, number = (*reader.GetSize(), 1)[:3]
    if math.prod(reader.GetSize()[3:]) != 1:
        raise ValueError(f"it has {len(reader.GetSize())} dimensions of {reader.GetSize()}: a stack of views has three")
    if list(slices) == list(range(number)):
        return sitk.GetArrayFromImage(reader.Execute()).reshape(number, rows, cols)
    found = []
    for index in slices:
        reader.SetExtractIndex([0, 0, index])
        reader.SetExtractSize([cols, rows, 1])
        found.append(sitk.GetArrayFromImage(reader.Execute())[0])
    return np.stack(found)


@dataclass(frozen=True)
class PixelHeader:
    """Where the pixels of a stack of images are, by its header.

    Attributes:
        shape: (rows, cols).
        pixel_spacing: (dv, du), mm; None for 1 x 1, which headers say that say nothing.
        origin_mm: (u, v) of the centre of pixel (0, 0).
    """

    shape: tuple[int, int]
    pixel_spacing: tuple[float, float] | None
    origin_mm: tuple[float, float]


def image_header(path: Path) -> PixelHeader | None:
    """The header of a stack of images; None for what is no image, or has none.

    Raises:
        ValueError: it cannot be read.
    """
    if path.suffix.lower() not in (".mha", ".mhd", ".nrrd", ".nhdr", ".nii"):
        return None
    try:
        reader = opened(path)
    except RuntimeError as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise ValueError(f"projections file {path} cannot be read: {reason}") from error
    (cols, rows), (du, dv), (u0, v0) = (x[:2] for x in (reader.GetSize(), reader.GetSpacing(), reader.GetOrigin()))
    return PixelHeader((rows, cols), None if du == dv == 1.0 else (dv, du), (u0, v0))


def read_image(path: Path) -> sitk.Image:
    """The image of a file; raises as `read_slices`."""
    return opened(path).Execute()


def opened(path: Path) -> sitk.ImageFileReader:
    """A reader that has read the header, and believes it; raises as `read_slices`."""
    if path.suffix.lower() in META_SUFFIXES:
        check_meta_header(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    needed = math.prod(reader.GetSize()) * reader.GetNumberOfComponents()  # of a byte or more each
    file = path.stat().st_size
    if not _is_detached(path) and not can_hold(file, needed):
        raise RuntimeError(f"its header asks for {needed} values, more than a file of {file} bytes can hold")
    return reader


def can_hold(file: int, needed: int) -> bool:
    """Whether a file of so many bytes can unpack to as many as are needed."""
    return needed <= max(_SMALLEST, _MOST_PACKED * file)


def _is_detached(path: Path) -> bool:
    """Whether a header's data are in another file, so that its own size says nothing."""
    if path.suffix.lower() in _DETACHED:
        return True
    with path.open("rb") as file:
        return path.suffix.lower() == ".nrrd" and re.search(rb"^data ?file:", file.read(4096), re.M | re.I) is not None

"""Image files through ITK, their sizes checked against their files before anything is allocated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

_MOST_PACKED = 5000  # how many times larger than its file an image can be: deflate and LZW pack less
_SMALLEST = 1 << 16  # bytes: what is not worth the question
_DETACHED = (".mhd", ".nhdr")  # headers whose data are in another file


def read_slices(path: Path, slices: Sequence[int]) -> NDArray:
    """Slices of a volume, in this order, without reading the others where the format allows: uncompressed ones.

    Raises:
        RuntimeError: It cannot be read, or its header asks for more than the file can hold.
    """
    reader = _opened(path)
    cols, rows = reader.GetSize()[:2]
    found = []
    for number in slices:
        reader.SetExtractIndex([0, 0, number])
        reader.SetExtractSize([cols, rows, 1])
        found.append(sitk.GetArrayFromImage(reader.Execute())[0])
    return np.stack(found)


def num_slices(path: Path) -> int:
    """How many slices a volume has, by its header; raises as `read_slices`."""
    return (*_opened(path).GetSize(), 1)[2]


def read_image(path: Path) -> sitk.Image:
    """The image of a file; raises as `read_slices`."""
    return _opened(path).Execute()


def _opened(path: Path) -> sitk.ImageFileReader:
    """A reader that has read the header, and believes it."""
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    needed = math.prod(reader.GetSize()) * reader.GetNumberOfComponents()  # of a byte or more each
    file = path.stat().st_size
    if path.suffix.lower() not in _DETACHED and needed > max(_SMALLEST, _MOST_PACKED * file):
        raise RuntimeError(f"its header asks for {needed} values, more than a file of {file} bytes can hold")
    return reader

"""Reading of image files with ITK or Pillow. Sizes in headers are checked before memory is allocated."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from PIL import Image

from torchkcreg.plain import first_line

PAGE_SUFFIXES = (".tif", ".tiff", ".png")
_SAMPLE_FORMAT, _BITS, _PHOTOMETRIC = 339, 258, 262  # TIFF tags
_UNSIGNED = 1
_GREY = ("L", "I", "F", "I;16", "I;16B", "I;16L", "I;16N")
META_SUFFIXES = (".mha", ".mhd")
_LONGEST = 1 << 16  # largest header in bytes
_FLAGS = ("BinaryData", "BinaryDataByteOrderMSB", "ElementByteOrderMSB", "CompressedData")
_MOST_PACKED = 5000  # upper limit of the compression ratio; deflate and LZW reach less
_SMALLEST = 1 << 16  # bytes; smaller sizes are not checked
_DETACHED = (".mhd", ".nhdr")  # headers whose data are in another file


def num_pages(path: Path) -> int:
    """Number of pages of a file. Raises the same errors as `read_pages`."""
    with _opened(path) as file:
        return int(getattr(file, "n_frames", 1))


def read_pages(path: Path, pages: Sequence[int]) -> NDArray:
    """Read pages (N, rows, cols) of a TIFF or PNG file, in the given order.

    Raises:
        ValueError: The file is damaged, in colour, has a data type that Pillow lacks (64 bits), or pages differ.
    """
    images = []
    with _opened(path) as file:
        for page in pages:
            file.seek(page)
            if file.mode not in _GREY:
                raise ValueError(f"page {page} is of kind {file.mode}, not grey numbers of up to 32 bits")
            images.append(_numbers(file, page))
    if len({(image.shape, image.dtype) for image in images}) > 1:
        raise ValueError("its pages are of different sizes or kinds")
    return np.stack(images)


def _numbers(file: Image.Image, page: int) -> NDArray:
    """The stored numbers of a page.

    Pillow reads unsigned 32-bit numbers as signed; this is undone. Pages in which white is zero and signed 8-bit pages
    are rejected, because Pillow changes their values.
    """
    tags = getattr(file, "tag_v2", {})
    sample, bits = (tags.get(tag, (default,)) for tag, default in ((_SAMPLE_FORMAT, _UNSIGNED), (_BITS, 8)))
    kind = sample[0] if isinstance(sample, tuple) else sample
    depth = bits[0] if isinstance(bits, tuple) else bits
    if tags and tags.get(_PHOTOMETRIC) == 0:
        raise ValueError(f"page {page} says that white is zero: write it with black as zero")
    if tags and kind != _UNSIGNED and depth == 8:
        raise ValueError(f"page {page} has signed numbers of 8 bits: write it with 16")
    image = np.array(file)
    return image.view(np.uint32) if tags and depth == 32 and kind == _UNSIGNED and image.dtype == np.int32 else image


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            warnings.simplefilter("ignore", UserWarning)
            with Image.open(path, formats=("TIFF", "PNG")) as file:
                yield file
    except ValueError:
        raise
    except Exception as error:  # Pillow and its decoders raise various types
        raise ValueError(f"is no image that can be read: {first_line(error, otherwise='damaged')}") from error


def check_meta_header(path: Path) -> None:
    """Check that a MetaImage header is valid.

    An invalid flag makes ITK read binary data as text and write out of bounds.

    Raises:
        RuntimeError: The header is not valid.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST)
    end = re.search(rb"^ElementDataFile[ \t]*[=:].*$", start, re.MULTILINE)
    if end is None:
        raise RuntimeError("its header has no ElementDataFile")
    lines = start[: end.end()].decode("latin-1").splitlines()
    parts = [re.sub("[=:]", "=", line, count=1).partition("=") for line in lines]
    pairs = [(key.strip(), value.strip()) for key, _, value in parts]
    header = dict(pairs)
    for key in (*_FLAGS, "NDims", "DimSize", "ElementNumberOfChannels"):
        if [name for name, _ in pairs].count(key) > 1:
            raise RuntimeError(f"its header has {key} twice")
    for flag in _FLAGS:
        if header.get(flag, "True").lower() not in ("true", "false", "t", "f", "1", "0"):
            raise RuntimeError(f"its header's {flag} must be True or False, got {header[flag]!r}")
    sizes = header.get("DimSize", "").split()
    if not re.fullmatch(r"[1-4]", header.get("NDims", "")) or len(sizes) != int(header["NDims"]):
        raise RuntimeError("its header's NDims and DimSize do not fit together")
    if not all(re.fullmatch(r"[1-9]\d{0,9}", size) for size in sizes):
        raise RuntimeError(f"its header's DimSize must be positive whole numbers, got {header['DimSize']!r}")
    if not re.fullmatch(r"[1-9]\d{0,3}", header.get("ElementNumberOfChannels", "1")):
        raise RuntimeError("its header's ElementNumberOfChannels must be a positive whole number")


def read_slices(path: Path, slices: Sequence[int]) -> NDArray:
    """Read slices of a volume in the given order. Other slices of uncompressed files are not read if the format allows.

    Raises:
        RuntimeError: The file cannot be read, or its header claims more data than the file can hold.
        ValueError: The file has more than one number per pixel, or is no stack of two-dimensional images.
    """
    reader = opened(path)
    if reader.GetNumberOfComponents() != 1:
        raise ValueError(f"it has {reader.GetNumberOfComponents()} numbers a pixel: grey images have one")
    cols, rows, number = (*reader.GetSize(), 1)[:3]
    if math.prod(reader.GetSize()[3:]) != 1:
        raise ValueError(f"it has {len(reader.GetSize())} dimensions of {reader.GetSize()}: a stack of views has three")
    if list(slices) == list(range(number)):
        return sitk.GetArrayFromImage(reader.Execute()).reshape(number, rows, cols)
    images = []
    for index in slices:
        reader.SetExtractIndex([0, 0, index])
        reader.SetExtractSize([cols, rows, 1])
        images.append(sitk.GetArrayFromImage(reader.Execute())[0])
    return np.stack(images)


@dataclass(frozen=True)
class PixelHeader:
    """Size, spacing and origin of the pixels of an image stack, from its header.

    Attributes:
        shape: (rows, cols).
        pixel_spacing: (dv, du), mm. None for 1 x 1 mm, a common default of image writers that is treated as missing.
        origin_mm: (u, v) of the centre of pixel (0, 0).
    """

    shape: tuple[int, int]
    pixel_spacing: tuple[float, float] | None
    origin_mm: tuple[float, float]


def image_header(path: Path) -> PixelHeader | None:
    """The header of an image stack; None if the format is none with such a header (MHA, MHD, NRRD, NHDR, NII).

    Raises:
        ValueError: The file cannot be read.
    """
    if path.suffix.lower() not in (".mha", ".mhd", ".nrrd", ".nhdr", ".nii"):
        return None
    try:
        reader = opened(path)
    except RuntimeError as error:
        reason = first_line(error, line=-1)
        raise ValueError(f"projections file {path} cannot be read: {reason}") from error
    (cols, rows), (du, dv), (u0, v0) = (x[:2] for x in (reader.GetSize(), reader.GetSpacing(), reader.GetOrigin()))
    return PixelHeader((rows, cols), None if du == dv == 1.0 else (dv, du), (u0, v0))


def read_image(path: Path) -> sitk.Image:
    """Read the image of a file. Raises the same errors as `read_slices`."""
    return opened(path).Execute()


def opened(path: Path) -> sitk.ImageFileReader:
    """An ITK reader that has read and checked the header of a file.

    Raises:
        RuntimeError: The file cannot be read, or its header claims more data than the file can hold.
    """
    if path.suffix.lower() in META_SUFFIXES:
        check_meta_header(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    needed = math.prod(reader.GetSize()) * reader.GetNumberOfComponents()  # each takes at least one byte
    file = path.stat().st_size
    if not _is_detached(path) and not can_hold(file, needed):
        raise RuntimeError(f"its header asks for {needed} values, more than a file of {file} bytes can hold")
    return reader


def can_hold(file: int, needed: int) -> bool:
    """True if a file of `file` bytes can decompress to `needed` bytes."""
    return needed <= max(_SMALLEST, _MOST_PACKED * file)


def _is_detached(path: Path) -> bool:
    """True if the image data are in another file than the header, so the file size gives no limit."""
    if path.suffix.lower() in _DETACHED:
        return True
    with path.open("rb") as file:
        return path.suffix.lower() == ".nrrd" and re.search(rb"^data ?file:", file.read(4096), re.M | re.I) is not None

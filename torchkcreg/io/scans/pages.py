"""Pages of TIFF and PNG files (Pillow)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

PAGE_SUFFIXES = (".tif", ".tiff", ".png")
_SAMPLE_FORMAT, _BITS, _PHOTOMETRIC = 339, 258, 262  # tags
_UNSIGNED = 1
_GREY = ("L", "I", "F", "I;16", "I;16B", "I;16L", "I;16N")


def num_pages(path: Path) -> int:
    """How many pages a file has; raises as `read_pages`."""
    with _opened(path) as file:
        return int(getattr(file, "n_frames", 1))


def read_pages(path: Path, pages: Sequence[int]) -> NDArray:
    """Pages (N, rows, cols) of a file, in this order.

    Raises:
        ValueError: damaged, in colours, of numbers that Pillow has none for (64 bits), or pages differ.
    """
    found = []
    with _opened(path) as file:
        for page in pages:
            file.seek(page)
            if file.mode not in _GREY:
                raise ValueError(f"page {page} is of kind {file.mode}, not grey numbers of up to 32 bits")
            found.append(_numbers(file, page))
    if len({(image.shape, image.dtype) for image in found}) > 1:
        raise ValueError("its pages are of different sizes or kinds")
    return np.stack(found)


def _numbers(file: Image.Image, page: int) -> NDArray:
    """A page as it is stored: Pillow takes unsigned numbers of 32 bits for signed ones, and turns others over."""
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
    except Exception as error:  # Pillow's and its decoders' own
        raise ValueError(f"is no image that can be read: {(str(error).splitlines() or ['damaged'])[0]}") from error

"""Image series of all formats: stacks, folders of images, raw data, HDF5, DICOM, and scan descriptions (YAML)."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from torchkcreg.io.config import read_config
from torchkcreg.options import Config
from torchkcreg.plain import first_line

from .dicom import DICOM_SUFFIXES, dicom_files, dicom_images, is_dicom
from .hdf5 import HDF5_SUFFIXES, open_hdf5
from .images import PAGE_SUFFIXES, num_pages, opened, read_pages, read_slices
from .plausible import ImageHeader
from .series import ImageSeries, in_order

DESCRIPTION_SUFFIXES = (".yaml", ".yml")
STACK_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr", ".nii", ".nii.gz")
VIEW_SUFFIXES = (*STACK_SUFFIXES, *PAGE_SUFFIXES, *DICOM_SUFFIXES)  # formats for folders with one file per view
SERIES_SUFFIXES = (".npy", *VIEW_SUFFIXES, *HDF5_SUFFIXES, *DESCRIPTION_SUFFIXES)


class RawHeader(Config):
    """Layout of a raw file without a header.

    Attributes:
        shape: (views, rows, cols). For flat and dark fields, the number of images follows from the file size.
        type: Data type.
        byte_order: Byte order of multi-byte numbers.
        skip_bytes: Number of bytes before the first number.
    """

    shape: tuple[int, int, int]
    type: Literal["uint8", "uint16", "int16", "uint32", "int32", "float32", "float64"]
    byte_order: Literal["little", "big"] = "little"
    skip_bytes: int = Field(0, ge=0)

    def mapped(self, path: Path, *, views: bool = True) -> NDArray:
        """Memory-map the numbers (V, rows, cols) of a file.

        Args:
            path: The file.
            views: Require the number of views in `shape`. If False, it follows from the file size.

        Raises:
            ValueError: The file size does not fit.
        """
        kind = np.dtype(self.type).newbyteorder("<" if self.byte_order == "little" else ">")
        if min(self.shape) < 1:
            raise ValueError(f"raw.shape must be positive, got {self.shape}")
        num_bytes, image = path.stat().st_size - self.skip_bytes, math.prod(self.shape[1:]) * kind.itemsize
        number = self.shape[0] if views else max(num_bytes // image, 1)
        if num_bytes != number * image:
            raise ValueError(
                f"{path.name} holds {num_bytes} bytes after the first {self.skip_bytes}, {number} images of "
                f"{self.shape[1]} x {self.shape[2]} {self.type} are {number * image}"
            )
        return np.memmap(path, kind, "r", offset=self.skip_bytes, shape=(number, *self.shape[1:]))


class ScanDescription(Config):
    """Contents of a scan description. Paths are relative to its folder and must lie within it.

    Attributes:
        images: File or folder of the views.
        flat: File or folder of open-beam images; their mean is used.
        dark: File or folder of images without a beam; their mean is subtracted from views and open beam.
        open_beam: One number instead of `flat`. Without `flat` and `open_beam`, images are line integrals.
        saturation: Saturation level of the detector.
        line_integrals: True if images are line integrals. By default, they are if there is no open beam.
        dataset: Name of the dataset within HDF5 files.
        raw: Layout of files without a header.
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
    """Read a scan description and check that its files exist.

    Raises:
        FileNotFoundError: A file or folder that it names is missing.
        ValueError: Unknown keys, invalid values, or a path outside its folder.
    """
    scan = ScanDescription.of(read_config(path), f"scan description {path}")
    if scan.flat is not None and scan.open_beam is not None:
        raise ValueError("flat and open_beam both define the open beam: name one")
    if scan.line_integrals and (scan.flat is not None or scan.dark is not None or scan.open_beam is not None):
        raise ValueError("line integrals need no flat, dark or open_beam")
    if scan.dark is not None and scan.flat is None and scan.open_beam is None:
        raise ValueError("a dark field alone leaves the open beam unknown: name flat or open_beam")
    places = {name: place for name in ("images", "flat", "dark") if (place := getattr(scan, name)) is not None}
    return scan.model_copy(update={name: _place(path, place) for name, place in places.items()})


def _place(path: Path, name: Path) -> Path:
    """The path of a file or folder named in the description at `path`."""
    place = path.parent / name
    # A link within the folder may lead to data elsewhere.
    if name.is_absolute() or os.path.normpath(name).startswith(".."):
        raise ValueError(
            f"{name} lies outside the description's folder: paths are relative to it and must lie within it"
        )
    if not place.exists():
        raise FileNotFoundError(f"{name}, which scan description {path} names, does not exist")
    return place


def open_series(path: Path) -> ImageSeries:
    """Open the images of a file (see `SERIES_SUFFIXES`), or of a folder with one file per view, sorted by number.

    Raises:
        ValueError: The format is unknown, a file is damaged, or the files of a folder do not belong together.
        FileNotFoundError: A file that a description names is missing.
    """
    if path.is_dir():
        return _of_folder(path)
    suffix = path.suffix.lower()
    if suffix in DESCRIPTION_SUFFIXES:
        return _described(path)
    if suffix in HDF5_SUFFIXES:
        return open_hdf5(path)
    if suffix == ".npy":
        return _of_array(np.load(path, mmap_mode="r", allow_pickle=False))
    if _kind(path) is not None:
        return _of_images(path)
    known = ", ".join((".npz", *SERIES_SUFFIXES))
    raise ValueError(f"projections are {known}, or a folder of images, not {suffix or 'without a suffix'}")


def _of_images(path: Path) -> ImageSeries:
    """The images of a single image file (TIFF, PNG, DICOM, ITK formats)."""
    suffix = path.suffix.lower()
    if suffix in PAGE_SUFFIXES:
        return ImageSeries(num_pages(path), lambda views: read_pages(path, views))
    if is_dicom(path):
        return _of_array(dicom_images(path))
    reader = opened(path)
    number = (*reader.GetSize(), 1)[2]
    return ImageSeries(number, lambda views: read_slices(path, views), header=ImageHeader.of(reader))


def _of_array(array: NDArray) -> ImageSeries:
    if array.ndim != 3:
        raise ValueError(f"images must be numbers of shape (V, rows, cols), got {array.dtype} {array.shape}")
    return ImageSeries(len(array), lambda views: np.asarray(array[list(views)]))


def _of_folder(folder: Path) -> ImageSeries:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    kinds = {file: kind for file in files if (kind := _kind(file)) is not None}
    if len(formats := sorted(set(kinds.values()))) != 1:
        what = f"files of several kinds ({', '.join(formats)})" if formats else "no images"
        raise ValueError(f"a folder of projections holds one image file a view, this one holds {what}")
    if formats == ["DICOM"]:
        views = dicom_files(folder)
    else:
        views = in_order(kinds)
        _check_numbers(views)
    first, header = _single(views[0])

    def read(indices: Sequence[int]) -> NDArray:
        return np.stack([_alike(views[index], first) for index in indices])

    return ImageSeries(len(views), read, header=header)


def _kind(file: Path) -> str | None:
    """Format of an image file; None if it is no known image file."""
    if is_dicom(file):
        return "DICOM"
    name = file.name.lower()
    aliases = {".tiff": ".tif", ".nii.gz": ".nii"}
    return next((aliases.get(kind, kind) for kind in (*STACK_SUFFIXES, *PAGE_SUFFIXES) if name.endswith(kind)), None)


def _single(file: Path) -> tuple[NDArray, ImageHeader | None]:
    """The single image (rows, cols) of a file, and its header."""
    try:
        series = _of_images(file)
        if series.num_views != 1:
            raise ValueError(f"it holds {series.num_views} images")
        return series.read([0])[0], series.header
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{file.name} cannot be read: {first_line(error, line=-1, otherwise='damaged')}") from error


def _alike(file: Path, first: NDArray) -> NDArray:
    image = _single(file)[0]
    if image.shape != first.shape or image.dtype != first.dtype:
        kinds = [f"{x.shape[0]} x {x.shape[1]} {x.dtype}" for x in (image, first)]
        raise ValueError(f"{file.name} is {kinds[0]}, the first image is {kinds[1]}")
    return image


def _check_numbers(files: list[Path]) -> None:
    """Warn if the view numbers (the last number in each file name) have a gap."""
    digit_groups = [re.findall(r"\d+", file.name.split(".")[0]) for file in files]
    if len(files) < 3 or not all(digit_groups):
        return
    numbers = sorted(int(digits[-1]) for digits in digit_groups)
    steps = np.diff(numbers)
    if (steps > np.median(steps)).any() and (steps > 0).all():
        gap = int(np.argmax(steps > np.median(steps)))
        warnings.warn(
            f"folder {files[0].parent}: images are numbered {numbers[gap]} and then {numbers[gap + 1]}: "
            "is a view missing?",
            stacklevel=4,
        )


def _described(path: Path) -> ImageSeries:
    """The images, flat and dark fields of a scan description."""
    scan = read_description(path)
    series = _opened(scan, scan.images)
    size = series.read([0]).shape[1:]
    beside = dict(series.beside)
    for name, place in (("open_beam", scan.flat), ("dark", scan.dark)):
        if place is not None:
            fields = _opened(scan, place)
            mean = fields.mean(range(fields.num_views))
            if mean.shape != size:
                raise ValueError(f"{place.name} has images of {mean.shape} pixels, the views have {size}")
            beside[name] = mean
    if scan.open_beam is not None:
        beside["open_beam"] = np.asarray(scan.open_beam)
    if scan.saturation is not None:
        beside["saturation"] = np.asarray(scan.saturation)
    return ImageSeries(series.num_views, series.read, beside, series.header, scan.line_integrals)


def _opened(scan: ScanDescription, place: Path) -> ImageSeries:
    if scan.raw is not None:
        files = in_order(file for file in (place.iterdir() if place.is_dir() else [place]) if _is_raw(file))
        if files:
            return _of_raw(scan.raw, place, files, views=place == scan.images)
    if place.suffix.lower() in HDF5_SUFFIXES:
        return open_hdf5(place, scan.dataset)
    if place.suffix.lower() in DESCRIPTION_SUFFIXES:
        raise ValueError(f"{place.name} is another description: name images")
    return open_series(place)


def _is_raw(file: Path) -> bool:
    """True if a file has no known format and is read as raw data."""
    name = file.name.lower()
    return file.is_file() and not name.startswith(".") and not name.endswith(SERIES_SUFFIXES) and not is_dicom(file)


def _of_raw(raw: RawHeader, place: Path, files: list[Path], *, views: bool) -> ImageSeries:
    """The images of raw files, concatenated. If `views`, their number must be that of `raw.shape`."""
    parts = [raw.mapped(file, views=views and len(files) == 1) for file in files]
    images = [image for part in parts for image in part]
    if views and len(images) != raw.shape[0]:
        raise ValueError(f"{place.name} holds {len(images)} images, raw.shape says {raw.shape[0]}")
    return ImageSeries(len(images), lambda indices: np.stack([images[index] for index in indices]))

"""Views' images wherever they are: one file of many, a folder of many files, raw data, HDF5, DICOM."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchkcreg.io.scans.dicom import DICOM_SUFFIXES, dicom_files, dicom_images, is_dicom
from torchkcreg.io.scans.hdf5 import HDF5_SUFFIXES, open_hdf5
from torchkcreg.io.scans.images import opened, read_slices
from torchkcreg.io.scans.order import by_number
from torchkcreg.io.scans.pages import PAGE_SUFFIXES, num_pages, read_pages
from torchkcreg.io.scans.plausible import ImageHeader
from torchkcreg.io.scans.scan_description import DESCRIPTION_SUFFIXES, Described, read_description

STACK_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr", ".nii", ".nii.gz")
VIEW_SUFFIXES = (*STACK_SUFFIXES, *PAGE_SUFFIXES, *DICOM_SUFFIXES)  # of which a folder may hold one file a view
SERIES_SUFFIXES = (".npy", *VIEW_SUFFIXES, *HDF5_SUFFIXES, *DESCRIPTION_SUFFIXES)


@dataclass(frozen=True)
class ImageSeries:
    """Images of views that stay where they are until they are read.

    Attributes:
        num_views: how many there are.
        read: images (v, rows, cols) of a list of views, as they are stored.
        beside: what is said of them: "open_beam", "dark", each a number or an image (rows, cols), "saturation".
        header: what the file says of pixels and axes; None where it says nothing.
        lines: whether they are line integrals, where that is said; None where it is not.
    """

    num_views: int
    read: Callable[[Sequence[int]], NDArray]
    beside: dict[str, NDArray] = field(default_factory=dict)
    header: ImageHeader | None = None
    lines: bool | None = None

    def arrays(self, views: Sequence[int]) -> dict[str, NDArray]:
        """Images of the given views and what is said of them, by name; images of no stated kind are the "image"."""
        kind = {None: "image", True: "line_integrals", False: "intensity"}[self.lines]
        return {kind: self.read(views), **self.beside}


def open_series(path: Path) -> ImageSeries:
    """The images of a file (see `SERIES_SUFFIXES`), or of a folder with one file a view, in the order of their numbers.

    Raises:
        ValueError: no such kind of file, damaged, or a folder whose files do not belong together.
        FileNotFoundError: a file that a description names is missing.
    """
    if path.is_dir():
        return _of_folder(path)
    suffix = path.suffix.lower()
    if suffix in DESCRIPTION_SUFFIXES:
        return _described(path)
    if suffix in HDF5_SUFFIXES:
        return _of_hdf5(path, None)
    if suffix == ".npy":
        return _of_array(np.load(path, mmap_mode="r", allow_pickle=False))
    if _kind(path) is not None:
        return _of_images(path)
    known = ", ".join((".npz", *SERIES_SUFFIXES))
    raise ValueError(f"projections are {known}, or a folder of images, not {suffix or 'without a suffix'}")


def _of_images(path: Path) -> ImageSeries:
    """One file of images of the common kinds."""
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


def _of_hdf5(path: Path, dataset: str | None) -> ImageSeries:
    images = open_hdf5(path, dataset)
    return ImageSeries(images.num_views, images.read, images.beside)


def _of_folder(folder: Path) -> ImageSeries:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    kinds = {file: kind for file in files if (kind := _kind(file)) is not None}
    if len(found := sorted(set(kinds.values()))) != 1:
        what = f"files of several kinds ({', '.join(found)})" if found else "no images"
        raise ValueError(f"a folder of projections holds one image file a view, this one {what}")
    if found == ["DICOM"]:
        views = dicom_files(folder)
    else:
        views = sorted(kinds, key=by_number)
        _check_numbers(views)
    first, header = _single(views[0])

    def read(indices: Sequence[int]) -> NDArray:
        return np.stack([_alike(views[index], first) for index in indices])

    return ImageSeries(len(views), read, header=header)


def _kind(file: Path) -> str | None:
    """Of an image file; None for one that is something else."""
    if is_dicom(file):
        return "DICOM"
    name = file.name.lower()
    same = {".tiff": ".tif", ".nii.gz": ".nii"}
    return next((same.get(kind, kind) for kind in (*STACK_SUFFIXES, *PAGE_SUFFIXES) if name.endswith(kind)), None)


def _single(file: Path) -> tuple[NDArray, ImageHeader | None]:
    """The one image (rows, cols) of a file, and its header."""
    try:
        series = _of_images(file)
        if series.num_views != 1:
            raise ValueError(f"it holds {series.num_views} images")
        return series.read([0])[0], series.header
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{file.name} cannot be read: {(str(error).splitlines() or ['damaged'])[-1]}") from error


def _alike(file: Path, first: NDArray) -> NDArray:
    image = _single(file)[0]
    if image.shape != first.shape or image.dtype != first.dtype:
        kinds = [f"{x.shape[0]} x {x.shape[1]} {x.dtype}" for x in (image, first)]
        raise ValueError(f"{file.name} is {kinds[0]}, the first image is {kinds[1]}")
    return image


def _check_numbers(files: list[Path]) -> None:
    """Warns where the views' numbers, the last of each name, leave some out."""
    found = [re.findall(r"\d+", file.name.split(".")[0]) for file in files]
    if len(files) < 3 or not all(found):
        return
    numbers = sorted(int(digits[-1]) for digits in found)
    steps = np.diff(numbers)
    if (steps > np.median(steps)).any() and (steps > 0).all():
        at = int(np.argmax(steps > np.median(steps)))
        warnings.warn(
            f"folder {files[0].parent}: images are numbered {numbers[at]} and then {numbers[at + 1]}: "
            "is a view missing?",
            stacklevel=4,
        )


def _described(path: Path) -> ImageSeries:
    """Images, flat and dark fields as a description says."""
    scan = read_description(path)
    series = _opened(scan, scan.images)
    size = series.read([0]).shape[1:]
    beside = dict(series.beside)
    for name, place in (("open_beam", scan.flat), ("dark", scan.dark)):
        if place is not None:
            fields = _opened(scan, place)
            images = [fields.read([view])[0] for view in range(fields.num_views)]
            if images[0].shape != size:
                raise ValueError(f"{place.name} has images of {images[0].shape} pixels, the views have {size}")
            beside[name] = np.stack(images).mean(0, dtype=np.float64).astype(np.float32)
    if scan.open_beam is not None:
        beside["open_beam"] = np.asarray(scan.open_beam)
    if scan.saturation is not None:
        beside["saturation"] = np.asarray(scan.saturation)
    return ImageSeries(series.num_views, series.read, beside, series.header, scan.lines)


def _opened(scan: Described, place: Path) -> ImageSeries:
    if scan.raw is not None:
        if place.is_dir() and (files := [file for file in place.iterdir() if _is_raw(file)]):
            return _of_raw(scan, place, sorted(files, key=by_number))
        if place.is_file() and _is_raw(place):
            return _of_raw(scan, place, [place])
    if place.suffix.lower() in HDF5_SUFFIXES:
        return _of_hdf5(place, scan.dataset)
    if place.suffix.lower() in DESCRIPTION_SUFFIXES:
        raise ValueError(f"{place.name} is another description: name images")
    return open_series(place)


def _is_raw(file: Path) -> bool:
    """Whether a file has no header that is known."""
    name = file.name.lower()
    return file.is_file() and not name.startswith(".") and not name.endswith(SERIES_SUFFIXES) and not is_dicom(file)


def _of_raw(scan: Described, place: Path, files: list[Path]) -> ImageSeries:
    """Files without a header, one after the other."""
    assert scan.raw is not None
    parts = [scan.raw.mapped(file, views=len(files) == 1 and place == scan.images) for file in files]
    owners = [(part, index) for part in parts for index in range(len(part))]
    if place == scan.images and len(owners) != scan.raw.shape[0]:
        raise ValueError(f"{place.name} holds {len(owners)} images, raw.shape says {scan.raw.shape[0]}")
    return ImageSeries(len(owners), lambda views: np.stack([owners[view][0][owners[view][1]] for view in views]))

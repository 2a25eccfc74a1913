"""Views' images wherever they are: one file of many, a folder of many files, raw data, HDF5, DICOM."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchkcreg.io.scans.dicom import DICOM_SUFFIXES, dicom_files, dicom_images, is_dicom
from torchkcreg.io.scans.hdf5 import HDF5_SUFFIXES, open_hdf5
from torchkcreg.io.scans.images import opened, read_slices
from torchkcreg.io.scans.order import by_number
from torchkcreg.io.scans.pages import PAGE_SUFFIXES, num_pages, read_pages
from torchkcreg.io.scans.plausible import ImageHeader
from torchkcreg.io.scans.scan_description import DESCRIPTION_SUFFIXES, RawHeader, ScanDescription, read_description
from torchkcreg.io.scans.series import ImageSeries

STACK_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr", ".nii", ".nii.gz")
VIEW_SUFFIXES = (*STACK_SUFFIXES, *PAGE_SUFFIXES, *DICOM_SUFFIXES)  # of which a folder may hold one file a view
SERIES_SUFFIXES = (".npy", *VIEW_SUFFIXES, *HDF5_SUFFIXES, *DESCRIPTION_SUFFIXES)


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
        return open_hdf5(path)
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
        files = sorted(
            (file for file in (place.iterdir() if place.is_dir() else [place]) if _is_raw(file)), key=by_number
        )
        if files:
            return _of_raw(scan.raw, place, files, views=place == scan.images)
    if place.suffix.lower() in HDF5_SUFFIXES:
        return open_hdf5(place, scan.dataset)
    if place.suffix.lower() in DESCRIPTION_SUFFIXES:
        raise ValueError(f"{place.name} is another description: name images")
    return open_series(place)


def _is_raw(file: Path) -> bool:
    """Whether a file has no header that is known."""
    name = file.name.lower()
    return file.is_file() and not name.startswith(".") and not name.endswith(SERIES_SUFFIXES) and not is_dicom(file)


def _of_raw(raw: RawHeader, place: Path, files: list[Path], *, views: bool) -> ImageSeries:
    """Files without a header, one after the other; views are as many as the header says."""
    parts = [raw.mapped(file, views=views and len(files) == 1) for file in files]
    images = [image for part in parts for image in part]
    if views and len(images) != raw.shape[0]:
        raise ValueError(f"{place.name} holds {len(images)} images, raw.shape says {raw.shape[0]}")
    return ImageSeries(len(images), lambda indices: np.stack([images[index] for index in indices]))

"""Projections in HDF5: Data Exchange, NXtomo, or any dataset by name.

Files are read with pyfive, because the HDF5 library crashes on some damaged files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchkcreg.plain import first_line

from .images import can_hold
from .series import ImageSeries

HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".nxs")
_FILTERS = {
    4: "SZIP",
    32000: "LZF",
    32001: "Blosc",
    32004: "LZ4",
    32008: "bitshuffle",
    32013: "ZFP",
    32015: "Zstandard",
    32026: "Blosc2",
}
_READ_BY_ALL = 3  # deflate, shuffle, checksum
_DEEPEST = 8  # groups inside groups; links can go round in circles
_OTHER_FILE = re.compile(rb"[\w./ -]+\.(?:h5|hdf5|hdf|nxs)")
_LINKS_WITHIN = 1 << 20
_PROJECTION, _FLAT, _DARK = 0, 1, 2  # values of NXtomo's image_key


def open_hdf5(path: Path, dataset: str | None = None) -> ImageSeries:
    """The projections of an HDF5 file, with the means of its flat and dark fields.

    Without a name, the dataset is that of Data Exchange (`exchange/data`, with `data_white` and `data_dark`), that of
    NXtomo (`image_key` beside `data`), or the only three-dimensional dataset.

    Raises:
        ValueError: The file is no HDF5, lacks the dataset, or several datasets are possible.
        ImportError: pyfive is not installed.
    """
    try:
        import pyfive
    except ImportError:
        raise ImportError("HDF5 files need pyfive: pip install 'torchkcreg[io]'") from None
    with _opened(pyfive, path) as file, _explained(path):
        stacks = dict(_stacks(file))
        name = _chosen(stacks, dataset)
        data = stacks[name]
        _check(data, name, path)
        fields: dict[str, NDArray] = {}
        views = list(range(data.shape[0]))
        parent = data.parent
        if name.endswith("exchange/data"):
            for key, kind in (("data_white", "open_beam"), ("data_dark", "dark")):
                if key in parent:
                    _check(parent[key], key, path)
                    fields[kind] = _field(parent[key], key, tuple(data.shape[1:]))
        elif "image_key" in parent and tuple(parent["image_key"].shape) == (data.shape[0],):
            keys = parent["image_key"][()]
            views = np.flatnonzero(keys == _PROJECTION).tolist()
            for number, kind in ((_FLAT, "open_beam"), (_DARK, "dark")):
                if (keys == number).any():
                    fields[kind] = _plain(data).mean(np.flatnonzero(keys == number).tolist())

    def read(indices: Sequence[int]) -> NDArray:
        with _opened(pyfive, path) as reopened, _explained(path, reopened[name]):
            images = np.stack([np.asarray(reopened[name][views[index]]) for index in indices])
        if images.ndim != 3 or images.dtype.kind not in "uif":
            raise ValueError(f"dataset {name} gives no images: is it a virtual dataset? Write it as a plain one")
        return images

    return ImageSeries(len(views), read, fields)


def _opened(pyfive: Any, path: Path) -> Any:
    try:
        return pyfive.File(str(path))
    except Exception as error:  # pyfive and struct raise various types on damaged files
        raise ValueError(f"is no HDF5 file that can be read: {first_line(error, otherwise='damaged')}") from error


def _stacks(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and datasets of three dimensions in a group and all groups in it; broken links are passed over."""
    for key in group:
        try:
            item = group[key]
        except KeyError:
            continue
        if getattr(item, "ndim", 0) == 3:
            yield f"{prefix}{key}", item
        elif hasattr(item, "keys") and prefix.count("/") < _DEEPEST:
            yield from _stacks(item, f"{prefix}{key}/")


@contextmanager
def _explained(path: Path, data: Any = None) -> Iterator[None]:
    """Turn errors of the reader's library into what a user can do about them."""
    try:
        yield
    except (ValueError, OSError):
        raise
    except AssertionError as error:  # how the library ends at a link that leaves the file
        others = sorted(set(_OTHER_FILE.findall(path.read_bytes()[:_LINKS_WITHIN])) - {path.name.encode()})
        named = f", {others[0].decode()}" if len(others) == 1 else ""
        raise ValueError(f"holds a link to another file{named}: give the file that holds the data") from error
    except (ImportError, NotImplementedError) as error:
        how = f"by {_filters(data)}" if data is not None else "in a way"
        raise ValueError(
            f"is compressed {how}, which cannot be read here: rewrite it, by h5repack -f GZIP=4 {path.name} new.h5"
        ) from error
    except KeyError as error:
        missing = error.args[0] if error.args else None
        if not isinstance(missing, tuple):
            raise ValueError(f"cannot be read: it has no {first_line(error)}") from error
        raise ValueError(
            f"view {missing[0]} was never written: was the scan stopped? Write a dataset of the views that are there"
        ) from error
    except Exception as error:  # zlib, struct and others on damaged data
        raise ValueError(f"cannot be read: {first_line(error, otherwise='damaged')}") from error


def _filters(data: Any) -> str:
    """Names of the compression filters of a dataset."""
    pipeline = getattr(data.id, "filter_pipeline", None) or []
    numbers = [int(step.get("filter_id", -1)) for step in pipeline]
    names = [_FILTERS.get(number, f"filter {number}") for number in numbers if number > _READ_BY_ALL]
    return " and ".join(names) or "a filter"


def _chosen(stacks: dict[str, Any], dataset: str | None) -> str:
    if dataset is not None:
        if dataset.strip("/") not in stacks:
            raise ValueError(f"has no dataset {dataset} of three dimensions; it has {', '.join(stacks) or 'none'}")
        return dataset.strip("/")
    stacks = {name: data for name, data in stacks.items() if not name.endswith(("data_white", "data_dark"))}
    known = [name for name, data in stacks.items() if name.endswith("exchange/data") or "image_key" in data.parent]
    measured = [name for name in known if "detector/" in name]  # the others are links to it
    for names in (known, measured, list(stacks)):
        if len(names) == 1:
            return names[0]
    if not stacks:
        raise ValueError("has no dataset of three dimensions")
    raise ValueError(
        f"has {len(stacks)} datasets of three dimensions ({', '.join(list(stacks)[:5])}): name one as `dataset` in a "
        "scan description"
    )


def _check(data: Any, name: str, path: Path) -> None:
    if data.dtype.kind not in "uif":
        raise ValueError(f"dataset {name} holds no numbers, but {data.dtype}")
    size = path.stat().st_size
    if data.size == 0 or not can_hold(size, data.size * data.dtype.itemsize):
        raise ValueError(f"dataset {name} claims {data.shape} numbers, more than a file of {size} bytes can hold")


def _field(data: Any, name: str, shape: tuple[int, ...]) -> NDArray:
    """A flat or dark field (rows, cols): a single image, or the mean of several."""
    if tuple(data.shape) == shape:
        return np.asarray(data[()]).astype(np.float32)
    if tuple(data.shape[1:]) != shape:
        raise ValueError(f"dataset {name} must hold images {shape}, got shape {tuple(data.shape)}")
    return _plain(data).mean(range(data.shape[0]))


def _plain(data: Any) -> ImageSeries:
    """All images of a dataset as a series."""
    return ImageSeries(data.shape[0], lambda indices: np.stack([np.asarray(data[int(index)]) for index in indices]))

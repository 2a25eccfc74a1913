"""Files of projections."""

from __future__ import annotations

import logging
import os
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchkcreg.io.files import atomic_path, existing_place, physical_memory

from .image_series import open_series
from .measured import Projections, check_views, converted
from .plausible import ImageHeader, implausible_images

log = logging.getLogger(__name__)
_ARRAYS = ("intensity", "open_beam", "line_integrals", "mask", "saturation", "dark")


class ProjectionFile:
    """A file of projections of which some views are read at a time; `len` says how many there are.

    Files: all that `read_projections` reads but `.npz`; compressed stacks are unpacked as a whole each time. A
    detector's ceiling, and pixels that are stuck there, are told from the views that are read together.

    Args:
        path: The file.
        open_beam: Intensity of the unattenuated beam, one number or one image; line integrals if None.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or is an `.npz`, which can only be read as a whole.
    """

    def __init__(self, path: str | os.PathLike[str], *, open_beam: ArrayLike | None = None) -> None:
        self.path, self.open_beam = existing_place(path, "projections"), open_beam
        if self.path.suffix.lower() == ".npz":
            raise self._error(ValueError("views are read one by one from all kinds but .npz: write it as another"))
        try:
            self._series = open_series(self.path)
        except (ValueError, RuntimeError, OSError, TypeError) as error:
            raise self._error(error) from error

    def __len__(self) -> int:
        return self._series.num_views

    def read(self, views: Sequence[int]) -> Projections:
        """Some views, in this order, as `read_projections` gives them.

        Raises:
            ValueError: If there is no such view, or what it holds is no image.
        """
        try:
            check_views(views, len(self))
            return converted(self._series.arrays(views), self._beam(views), None, None)
        except (ValueError, RuntimeError) as error:
            raise self._error(error) from error

    def _beam(self, views: Sequence[int]) -> ArrayLike | None:
        """The open beam of some views, where it is told for each."""
        beam = None if self.open_beam is None else np.asarray(self.open_beam)
        return beam[list(views)] if beam is not None and beam.ndim in (1, 3) and len(beam) == len(self) else beam

    def _error(self, error: Exception) -> ValueError:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        return ValueError(f"projections file {self.path}: {reason}")


def read_projections(
    path: str | os.PathLike[str],
    *,
    open_beam: ArrayLike | None = None,
    saturation: float | None = None,
    views: Sequence[int] | None = None,
) -> Projections:
    """Projections of a file as line integrals, with a mask.

    Files: `.npz` with `intensity` and `open_beam` (the intensity without an object), or with `line_integrals`, and
    optionally `dark` (the intensity without a beam), `mask` (nonzero where a pixel counts) and `saturation`; HDF5, with
    flat and dark fields as Data Exchange and NXtomo have them; a scan's description in YAML (`ScanDescription`), which
    names files, raw data, flat and dark fields; `.npy`, the images that SimpleITK reads (`.mha`, `.nrrd`, `.nii`,
    `.tif`, `.dcm`; the slices are the views, row 0 has the smallest v), and folders with one image a view, in the order
    of the numbers in their names: line integrals, or intensities where `open_beam` is given.

    Not finite values and intensities at or below zero are masked, counted, and replaced by the smallest intensity that
    is taken at its word, half a count of an integer image and a millionth of the open beam otherwise; not finite line
    integrals by 0. A *saturated*
    pixel says that its line integral is at most the ceiling's: it keeps that value and counts, because masking the
    open beam would cut the outline of the limb out of every view; such pixels are flat and pull at nothing. Those that
    stand alone at the ceiling in every view are the detector's, not the beam's: they are masked.

    Args:
        path: the file.
        open_beam: intensity of the unattenuated beam, a number or an array that broadcasts to (V, rows, cols) or has
            shape (V,); overrides the file's own.
        saturation: the detector's ceiling. Without it the file's own, and without that the largest value of an
            integer image if it is 2^b - 1 with b = 8, 10, 12, 14 or 16.
        views: views to take, in this order; all of them if not given.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, has no views, lacks an open beam, or a requested view does not exist.
    """
    path = existing_place(path, "projections")
    try:
        arrays, header = _load(path)
        projections = converted(arrays, open_beam, saturation, views)
        doubts = implausible_images(projections.line_integrals, projections.mask)
    except ValueError as error:
        raise ValueError(f"projections file {path}: {error}") from error
    log.info("projections %s: %d views of %d x %d pixels", path, *projections.line_integrals.shape)
    for doubt in doubts:
        warnings.warn(f"projections file {path}: {doubt}", stacklevel=2)
    return replace(projections, header=header)


def write_stack(
    path: str | os.PathLike[str], line_integrals: Tensor, pixel_spacing: Sequence[float] | None = None
) -> None:
    """Nothing; writes line integrals (V, rows, cols) as an image stack (MHA, NRRD, NIfTI), single precision.

    Args:
        path: the file.
        line_integrals: NaN where a pixel does not count.
        pixel_spacing: (dv, du) in mm, for the header; the origin is that of a centred detector, as RTK has it.
    """
    image = sitk.GetImageFromArray(line_integrals.detach().cpu().float().numpy())
    if pixel_spacing is not None:
        (dv, du), (rows, cols) = pixel_spacing, line_integrals.shape[-2:]
        image.SetSpacing((float(du), float(dv), 1.0))
        image.SetOrigin((-du * (cols - 1) / 2, -dv * (rows - 1) / 2, 0.0))
    with atomic_path(path) as temporary:
        sitk.WriteImage(image, str(temporary), True)


def _check_room(path: Path) -> None:
    """Nothing; ValueError where an archive unpacks to more than this machine's memory."""
    with zipfile.ZipFile(path) as archive:
        needed = sum(item.file_size for item in archive.infolist() if item.filename.removesuffix(".npy") in _ARRAYS)
    if needed > (memory := physical_memory()):
        raise ValueError(f"unpacks to {needed / 2**30:.0f} GiB, this machine has {memory / 2**30:.0f} GiB of memory")


def write_projections(
    path: str | os.PathLike[str],
    *,
    intensity: ArrayLike | Tensor | None = None,
    open_beam: ArrayLike | Tensor | None = None,
    line_integrals: ArrayLike | Tensor | None = None,
) -> None:
    """Nothing; writes a compressed `.npz` that `read_projections` reads: intensity and open beam, or line integrals.

    Raises:
        ValueError: neither or both kinds are given, or the name does not end in .npz.
    """
    if (intensity is None) == (line_integrals is None) or (intensity is None) != (open_beam is None):
        raise ValueError("write_projections takes intensity and open_beam, or line_integrals alone")
    if Path(path).suffix != ".npz":
        raise ValueError(f"projections are written to a .npz file, got {path}")
    given = {"intensity": intensity, "open_beam": open_beam, "line_integrals": line_integrals}
    arrays = {key: np.asarray(value) for key, value in given.items() if value is not None}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)  # type: ignore[arg-type]


def _load(path: Path) -> tuple[dict[str, NDArray], ImageHeader | None]:
    try:
        if path.suffix.lower() == ".npz":
            loaded = np.load(path, allow_pickle=False)
            if isinstance(loaded, np.ndarray):  # an array under an archive's name
                return {"image": loaded}, None
            with loaded as file:
                _check_room(path)
                return {key: file[key] for key in _ARRAYS if key in file.files}, None
        series = open_series(path)
        return series.arrays(range(series.num_views)), series.header
    except (FileNotFoundError, ImportError):
        raise
    except Exception as error:  # NumPy, zip archives and ITK's readers fail in many ways, and each means a damaged file
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        raise ValueError(f"cannot be read: {reason[0]}") from error

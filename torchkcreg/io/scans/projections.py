"""Reading and writing of projection files."""

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
from torchkcreg.plain import first_line

from .image_series import open_series
from .measured import Projections, check_views, converted
from .plausible import ImageHeader, implausible_images

log = logging.getLogger(__name__)
_ARRAYS = ("intensity", "open_beam", "line_integrals", "mask", "saturation", "dark")


class ProjectionFile:
    """A projection file whose views are read on demand; `len` is the number of views.

    All formats of `read_projections` except `.npz` are supported. Compressed stacks are decompressed as a whole at each
    read. The detector's saturation level and stuck pixels are determined from the views that are read together.

    Args:
        path: The file.
        open_beam: Intensity of the unattenuated beam: one number, one image, or one of these per view. If None, the
            file's open beam is used; without any, the values are line integrals.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, or is an `.npz`, which can only be read as a whole.
    """

    def __init__(self, path: str | os.PathLike[str], *, open_beam: ArrayLike | None = None) -> None:
        self.path, self.open_beam = existing_place(path, "projections"), open_beam
        if self.path.suffix.lower() == ".npz":
            raise self._error(ValueError("single views cannot be read from an .npz: use another format"))
        try:
            self._series = open_series(self.path)
        except (ValueError, RuntimeError, OSError, TypeError) as error:
            raise self._error(error) from error

    def __len__(self) -> int:
        return self._series.num_views

    def read(self, views: Sequence[int]) -> Projections:
        """Read views in the given order, as `read_projections` does.

        Raises:
            ValueError: A view does not exist or is no image.
        """
        try:
            check_views(views, len(self))
            return converted(self._series.arrays(views), self._beam(views), None, None)
        except (ValueError, RuntimeError) as error:
            raise self._error(error) from error

    def _beam(self, views: Sequence[int]) -> ArrayLike | None:
        """The open beam of the given views, if it is given per view; else the common one."""
        beam = None if self.open_beam is None else np.asarray(self.open_beam)
        return beam[list(views)] if beam is not None and beam.ndim in (1, 3) and len(beam) == len(self) else beam

    def _error(self, error: Exception) -> ValueError:
        reason = first_line(error, line=-1)
        return ValueError(f"projections file {self.path}: {reason}")


def read_projections(
    path: str | os.PathLike[str],
    *,
    open_beam: ArrayLike | None = None,
    saturation: float | None = None,
    views: Sequence[int] | None = None,
) -> Projections:
    """Read projections as line integrals with a mask.

    Formats:

    * `.npz` with `intensity` and `open_beam` (the intensity without an object), or with `line_integrals`; optionally
      `dark` (the intensity without a beam), `mask` (nonzero where a pixel is valid) and `saturation`.
    * HDF5, with flat and dark fields as in Data Exchange and NXtomo.
    * A scan description in YAML (`ScanDescription`) that names images, raw data, flat and dark fields.
    * `.npy`, image stacks (`.mha`, `.nrrd`, `.nii`, `.tif`, `.dcm`; the slices are the views, row 0 has the smallest
      v), and folders with one image per view, sorted by the numbers in their names. These hold line integrals, or
      intensities if `open_beam` is given.

    Invalid pixels are masked and counted. Non-finite line integrals are replaced by 0. Non-finite intensities and
    intensities at or below zero are replaced by the smallest accepted intensity: half a count for integer images, else
    a millionth of the open beam.

    The line integral of a *saturated* pixel is at most that of the saturation level. The pixel keeps this value and is
    valid, because masking the open beam would remove the outline of the limb from every view. Saturated regions are
    constant, so they exert no force in a registration. Isolated pixels that are saturated in every view are detector
    defects and are masked.

    Args:
        path: The file or folder.
        open_beam: Intensity of the unattenuated beam: a number, or an array that broadcasts to (V, rows, cols) or has
            shape (V,). It overrides the file's open beam.
        saturation: Saturation level of the detector. Default: the level given in the file, else the largest value of
            an integer image if that is 2^b - 1 with b = 8, 10, 12, 14 or 16.
        views: Views to read, in this order. Default: all.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, has no views, lacks an open beam, or a requested view does not exist.
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
    path: str | os.PathLike[str],
    line_integrals: Tensor,
    pixel_spacing: Sequence[float] | None = None,
    origin_mm: Sequence[float] | None = None,
) -> None:
    """Write line integrals (V, rows, cols) as an image stack (MHA, NRRD, NIfTI) in single precision.

    Args:
        path: The file.
        line_integrals: Line integrals, NaN where a pixel is masked.
        pixel_spacing: (dv, du) in mm for the header.
        origin_mm: Position (u, v) of pixel (0, 0) for the header. If only the spacing is given, it is that of a centred
            detector, as in RTK.
    """
    image = sitk.GetImageFromArray(line_integrals.detach().cpu().float().numpy())
    if pixel_spacing is not None:
        (dv, du), (rows, cols) = pixel_spacing, line_integrals.shape[-2:]
        image.SetSpacing((float(du), float(dv), 1.0))
        image.SetOrigin((-du * (cols - 1) / 2, -dv * (rows - 1) / 2, 0.0))
    if origin_mm is not None:
        image.SetOrigin((float(origin_mm[0]), float(origin_mm[1]), 0.0))
    with atomic_path(path) as temporary:
        sitk.WriteImage(image, str(temporary), True)


def _check_room(path: Path) -> None:
    """Check that the arrays of an archive fit into the machine's memory.

    Raises:
        ValueError: They do not.
    """
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
    """Write intensity and open beam, or line integrals, as a compressed `.npz` for `read_projections`.

    Raises:
        ValueError: Neither or both kinds are given, or the name does not end in .npz.
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
            if isinstance(loaded, np.ndarray):  # an NPY file with the suffix .npz
                return {"image": loaded}, None
            with loaded as file:
                _check_room(path)
                return {key: file[key] for key in _ARRAYS if key in file.files}, None
        series = open_series(path)
        return series.arrays(range(series.num_views)), series.header
    except (FileNotFoundError, ImportError):
        raise
    except Exception as error:  # NumPy, zipfile and ITK raise various types on a damaged file
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        raise ValueError(f"cannot be read: {reason[0]}") from error

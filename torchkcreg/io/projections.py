"""Measured projections as line integrals with a mask of the pixels that hold a measurement."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.io.files import atomic_path, existing_file
from torchkcreg.io.images import read_image
from torchkcreg.io.plausible import ImageHeader, implausible_images, stuck_pixels
from torchkcreg.physics import COUNT_FLOOR, line_integrals_from_intensity

IMAGE_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nii", ".nii.gz", ".tif", ".tiff")
RELATIVE_FLOOR = 1e-6
_ARRAYS = ("intensity", "open_beam", "line_integrals", "mask", "saturation")
DETECTOR_CEILINGS = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 16))


@dataclass(frozen=True)
class Projections:
    """Line integrals -ln(I / I0) and the pixels where they mean something.

    Attributes:
        line_integrals: float32 (V, rows, cols), finite everywhere (masked pixels hold a stand-in).
        mask: bool (V, rows, cols), True where a pixel counts.
        num_masked: how many pixels do not count, by reason: "not finite", "not positive" (intensities at or below
            zero), "in the file's mask", "stuck at the ceiling". Reasons that never occurred are left out.
        num_saturated: pixels at the detector's ceiling; they count (see `read_projections`).
        header: what the file says of pixels and axes; None where it says nothing.
    """

    line_integrals: Tensor
    mask: Tensor
    num_masked: dict[str, int] = field(default_factory=dict)
    num_saturated: int = 0
    header: ImageHeader | None = None

    def select(self, views: Sequence[int]) -> Projections:
        """The given views alone, in the given order; the counts stay those of the whole."""
        check_views(views, len(self.line_integrals))
        index = list(views)
        return replace(self, line_integrals=self.line_integrals[index], mask=self.mask[index])

    def masked_note(self) -> str | None:
        """How many pixels do not count, and why, in words; None where all do."""
        if not self.num_masked:
            return None
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.num_masked.items())
        return f"{sum(self.num_masked.values())} pixels are masked ({reasons})"

    def check_against(self, geometry: ConeBeamGeometry) -> None:
        """Nothing; ValueError when the geometry has another number of views or another detector.

        A header whose pixels or axes contradict the geometry gives a warning.
        """
        have = tuple(self.line_integrals.shape)
        want = (geometry.num_views, *(int(n) for n in geometry.det_shape))
        if have != want:
            raise ValueError(f"projections have (views, rows, cols) = {have}, the geometry has {want}")
        if self.header is not None:
            self.header.check_against(geometry)


def read_projections(
    path: str | os.PathLike[str],
    *,
    open_beam: ArrayLike | None = None,
    saturation: float | None = None,
    views: Sequence[int] | None = None,
) -> Projections:
    """Projections of a file as line integrals, with a mask.

    Files: `.npz` with `intensity` and `open_beam` (the intensity without an object), or with `line_integrals`, and
    optionally `mask` (nonzero where a pixel counts) and `saturation`; `.npy` and the images SimpleITK reads (`.mha`,
    `.nrrd`, `.nii`, `.tif`; the slices are the views, row 0 has the smallest v): line integrals, or intensities where
    `open_beam` is given.

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
    path = existing_file(path, "projections")
    try:
        arrays, header = _load(path)
        projections = converted(arrays, open_beam, saturation, views)
        doubts = implausible_images(projections.line_integrals, projections.mask)
    except ValueError as error:
        raise ValueError(f"projections file {path}: {error}") from error
    for doubt in doubts:
        warnings.warn(f"projections file {path}: {doubt}", stacklevel=2)
    return replace(projections, header=header)


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
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".npy") and not path.name.lower().endswith(IMAGE_SUFFIXES):
        raise ValueError(f"projections are .npz, .npy, {', '.join(IMAGE_SUFFIXES)}, not {suffix or 'without a suffix'}")
    try:
        if suffix == ".npz":
            loaded = np.load(path, allow_pickle=False)
            if isinstance(loaded, np.ndarray):  # an array under an archive's name
                return {"image": loaded}, None
            with loaded as file:
                return {key: file[key] for key in _ARRAYS if key in file.files}, None
        if suffix == ".npy":
            return {"image": np.asarray(np.load(path, allow_pickle=False))}, None
        image = read_image(path)
        return {"image": sitk.GetArrayFromImage(image)}, ImageHeader.of(image)
    except Exception as error:  # NumPy, zip archives and ITK's readers fail in many ways, and each means a damaged file
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        raise ValueError(f"cannot be read: {reason[0]}") from error


def converted(
    arrays: dict[str, NDArray], open_beam: ArrayLike | None, saturation: float | None, views: Sequence[int] | None
) -> Projections:
    """What a file's arrays hold, by their names; an "image" is intensity where there is an open beam."""
    beam = arrays.get("open_beam") if open_beam is None else np.asarray(open_beam)
    if "image" in arrays:
        arrays["line_integrals" if beam is None else "intensity"] = arrays.pop("image")
    if ("intensity" in arrays) == ("line_integrals" in arrays):
        raise ValueError("needs either intensity (with open_beam) or line_integrals")
    kind = "intensity" if "intensity" in arrays else "line_integrals"
    image = arrays[kind]
    if image.ndim != 3 or 0 in image.shape or image.dtype.kind not in "uif":
        raise ValueError(f"{kind} must be numbers of shape (V, rows, cols), got {image.dtype} {image.shape}")
    kept = arrays.get("mask", np.broadcast_to(True, image.shape))
    if kept.shape != image.shape or kept.dtype.kind not in "buif":
        raise ValueError(f"mask must be numbers of the shape {image.shape} of {kind}, got {kept.dtype} {kept.shape}")
    mask = kept != 0
    beam = None if beam is None else _open_beam(beam, image.shape)
    if views is not None:
        check_views(views, len(image))
        index = list(views)
        image, mask = image[index], mask[index]
        beam = beam[index] if beam is not None and len(beam) > 1 else beam
    if kind == "line_integrals":
        return _from_line_integrals(image, mask)
    if beam is None:
        raise ValueError("has intensity but no open_beam, the intensity without an object: give it")
    if saturation is None and "saturation" in arrays:
        said = arrays["saturation"]
        if said.size != 1 or said.dtype.kind not in "uif":
            raise ValueError(f"saturation must be one number, got {said.dtype} {said.shape}")
        saturation = float(said.reshape(()))
    return _from_intensity(image, mask, beam, saturation)


def _from_line_integrals(image: NDArray, mask: NDArray) -> Projections:
    if image.dtype.kind in "ui":
        raise ValueError(f"{image.dtype} values look like intensities, not line integrals: give their open_beam")
    finite = np.abs(image) < np.finfo(np.float32).max  # which NaN is not either
    values = torch.from_numpy(np.where(finite, image, 0).astype(np.float32))
    return Projections(values, torch.from_numpy(finite & mask), _counts(finite, finite, mask))


def _from_intensity(image: NDArray, mask: NDArray, beam: NDArray, saturation: float | None) -> Projections:
    finite = np.abs(image) < np.finfo(np.float32).max
    positive = np.greater(image, 0, where=finite, out=np.zeros_like(finite))
    largest = image.max() if image.dtype.kind in "ui" else None
    ceiling = saturation if saturation is not None else largest if largest in DETECTOR_CEILINGS else None
    if ceiling is not None and ceiling <= 0:
        raise ValueError(f"saturation must be positive, got {ceiling}")
    saturated = np.zeros_like(finite) if ceiling is None else positive & (image >= ceiling)
    counts = torch.from_numpy(np.where(saturated, np.float64(ceiling or 0), image).astype(np.float32))
    floor = COUNT_FLOOR if image.dtype.kind in "ui" else RELATIVE_FLOOR * float(beam.min())
    line_integrals, valid = line_integrals_from_intensity(
        counts, torch.from_numpy(beam.astype(np.float32)), floor=floor
    )
    keep = valid & torch.from_numpy(finite & positive & mask)
    line_integrals = torch.where(torch.isfinite(line_integrals), line_integrals, 0.0).float()
    reasons = _counts(finite, positive, mask)
    if ceiling is not None and (stuck := stuck_pixels(image, saturated, float(ceiling))).any():
        reasons["stuck at the ceiling"] = int((stuck & keep.numpy()).sum())
        keep = keep & ~torch.from_numpy(stuck)
    return Projections(line_integrals, keep, reasons, int(saturated.sum()))


def _counts(finite: NDArray, positive: NDArray, mask: NDArray) -> dict[str, int]:
    counts = {
        "not finite": int((~finite).sum()),
        "not positive": int((finite & ~positive).sum()),
        "in the file's mask": int((positive & ~mask).sum()),
    }
    return {reason: count for reason, count in counts.items() if count}


def _open_beam(beam: NDArray, shape: tuple[int, ...]) -> NDArray:
    """The open beam with three dimensions that broadcast to `shape`."""
    if beam.dtype.kind not in "uif" or not np.isfinite(beam).all() or beam.size == 0 or beam.min() <= 0:
        raise ValueError(f"open_beam must be positive and finite, got {np.array2string(beam, threshold=4)}")
    if beam.ndim == 1 and len(beam) == shape[0]:
        beam = beam[:, None, None]
    try:
        np.broadcast_to(beam, shape)
    except ValueError:
        raise ValueError(f"open_beam must broadcast to {shape}, got shape {beam.shape}") from None
    return beam.reshape((1,) * (3 - beam.ndim) + beam.shape)


def check_views(views: Sequence[int], num_views: int) -> None:
    """Nothing; ValueError where there are no views, or one that does not exist."""
    if len(views) == 0:
        raise ValueError("views must name at least one view")
    for view in views:
        if not 0 <= view < num_views:
            raise ValueError(f"there is no view {view}: the projections have views 0 to {num_views - 1}")

"""Projections as line integrals with a mask of valid pixels, and the conversion from intensities."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.physics import COUNT_FLOOR, line_integrals_from_intensity

from .plausible import ImageHeader, aperture_rim, stuck_pixels

RELATIVE_FLOOR = 1e-6
DIVIDED, COUNTED = 2.0, 50.0  # largest transmission; smallest open beam of a detector that counts
OTHER_BEAM = 0.02  # relative difference of open beams that is worth a warning
MOSTLY = 0.5  # minimum fraction of pixels with an open beam above the dark field
DETECTOR_CEILINGS = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 16))


@dataclass(frozen=True)
class Projections:
    """Line integrals -ln(I / I0) with a mask of valid pixels.

    Attributes:
        line_integrals: float32 (V, rows, cols), finite everywhere (masked pixels hold a placeholder).
        mask: bool (V, rows, cols), True where a pixel is valid.
        num_masked: Number of masked pixels by reason: "not finite", "not positive" (intensities at or below zero, or
            the dark field), "in the file's mask", "without open beam", "stuck at the ceiling", "at the rim of the
            aperture". Reasons without pixels are omitted.
        num_saturated: Number of pixels at the detector's saturation level; they are valid (see `read_projections`).
        header: Pixel spacing and axes from the file; None if it gives none.
    """

    line_integrals: Tensor
    mask: Tensor
    num_masked: dict[str, int] = field(default_factory=dict)
    num_saturated: int = 0
    header: ImageHeader | None = None

    def select(self, views: Sequence[int]) -> Projections:
        """Select views in the given order. The counts still refer to all views."""
        check_views(views, len(self.line_integrals))
        index = list(views)
        return replace(self, line_integrals=self.line_integrals[index], mask=self.mask[index])

    def masked_note(self) -> str | None:
        """Text with the number of masked pixels and the reasons; None if no pixel is masked."""
        if not self.num_masked:
            return None
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.num_masked.items())
        return f"{sum(self.num_masked.values())} pixels are masked ({reasons})"

    def check_against(self, geometry: ConeBeamGeometry) -> None:
        """Check that views and detector fit a geometry.

        Warns if pixel spacing or axes in the header contradict the geometry.

        Raises:
            ValueError: The number of views, rows or columns differs.
        """
        shape = tuple(self.line_integrals.shape)
        expected = (geometry.num_views, *(int(n) for n in geometry.det_shape))
        if shape != expected:
            raise ValueError(f"projections have (views, rows, cols) = {shape}, the geometry has {expected}")
        if self.header is not None:
            self.header.check_against(geometry)


def converted(
    arrays: dict[str, NDArray], open_beam: ArrayLike | None, saturation: float | None, views: Sequence[int] | None
) -> Projections:
    """Convert the named arrays of a file to projections. An "image" is an intensity if there is an open beam."""
    beam = arrays.get("open_beam") if open_beam is None else np.asarray(open_beam)
    if "image" in arrays:
        arrays["line_integrals" if beam is None else "intensity"] = arrays.pop("image")
    if ("intensity" in arrays) == ("line_integrals" in arrays):
        raise ValueError("needs either intensity (with open_beam) or line_integrals")
    kind = "intensity" if "intensity" in arrays else "line_integrals"
    image = arrays[kind]
    if image.ndim != 3 or 0 in image.shape or image.dtype.kind not in "uif":
        raise ValueError(f"{kind} must be numbers of shape (V, rows, cols), got {image.dtype} {image.shape}")
    given_mask = arrays.get("mask", np.broadcast_to(True, image.shape))
    if given_mask.shape != image.shape or given_mask.dtype.kind not in "buif":
        raise ValueError(
            f"mask must be numbers of the shape {image.shape} of {kind}, got {given_mask.dtype} {given_mask.shape}"
        )
    mask = given_mask != 0
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
    _check_undivided(image, beam)
    if open_beam is not None and "open_beam" in arrays:
        _compare_beams(beam, arrays["open_beam"])
    dark = _dark(arrays["dark"], image.shape[1:]) if "dark" in arrays else np.zeros((1, 1, 1))
    if saturation is None and "saturation" in arrays:
        level = arrays["saturation"]
        if level.size != 1 or level.dtype.kind not in "uif":
            raise ValueError(f"saturation must be one number, got {level.dtype} {level.shape}")
        saturation = float(level.reshape(()))
    return _from_intensity(image, mask, beam, dark, saturation)


def _check_undivided(image: NDArray, beam: NDArray) -> None:
    """Raise ValueError if intensities were divided by the open beam already."""
    if image.dtype.kind != "f" or np.median(beam) < COUNTED:
        return
    largest = np.max(image, where=np.isfinite(image), initial=0.0)
    if 0 < largest <= DIVIDED:
        raise ValueError(
            f"intensities of at most {largest:.3g} beside an open beam of {np.median(beam):.4g} were divided "
            "already: give an open beam of 1 (--open-beam 1)"
        )


def _compare_beams(given: NDArray, stored: NDArray) -> None:
    """Warn if the given open beam differs from the file's own."""
    levels = [float(np.median(beam)) for beam in (given, stored) if beam.dtype.kind in "uif" and beam.size]
    if len(levels) == 2 and abs(levels[0] - levels[1]) > OTHER_BEAM * abs(levels[1]):
        warnings.warn(
            f"the file says an open beam of {levels[1]:.4g}, but {levels[0]:.4g} was given: that one is used",
            stacklevel=4,
        )


def _from_line_integrals(image: NDArray, mask: NDArray) -> Projections:
    if image.dtype.kind in "ui":
        raise ValueError(f"{image.dtype} values look like intensities, not line integrals: give their open_beam")
    finite = np.abs(image) < np.finfo(np.float32).max  # False for NaN too
    values = torch.from_numpy(np.where(finite, image, 0).astype(np.float32))
    return Projections(values, torch.from_numpy(finite & mask), _counts(finite, finite, mask))


def _from_intensity(
    image: NDArray, mask: NDArray, beam: NDArray, dark: NDArray, saturation: float | None
) -> Projections:
    finite = np.abs(image) < np.finfo(np.float32).max
    positive = np.greater(image, dark, where=finite, out=np.zeros_like(finite))
    lit = np.broadcast_to(beam > dark, image.shape).copy()
    if lit.mean() < MOSTLY:
        raise ValueError("open_beam must be above the dark field, or 0 without one, in most pixels")
    largest = image.max() if image.dtype.kind in "ui" else None
    if image.dtype == np.uint8:
        warnings.warn(
            "images of 8 bits are made for display, not in proportion to the intensity: outlines are right, but "
            "expected errors are too small",
            stacklevel=4,
        )
    ceiling = saturation if saturation is not None else largest if largest in DETECTOR_CEILINGS else None
    if ceiling is not None and ceiling <= 0:
        raise ValueError(f"saturation must be positive, got {ceiling}")
    saturated = np.zeros_like(finite) if ceiling is None else positive & (image >= ceiling)
    counts = np.where(saturated, np.float64(ceiling or 0), image) - dark
    net = np.where(beam > dark, beam - dark, 1.0)
    floor = COUNT_FLOOR if image.dtype.kind in "ui" else RELATIVE_FLOOR * float(net.min())
    line_integrals, valid = line_integrals_from_intensity(
        torch.from_numpy(counts.astype(np.float32)), torch.from_numpy(net.astype(np.float32)), floor=floor
    )
    keep = valid & torch.from_numpy(finite & positive & lit & mask)
    line_integrals = torch.where(torch.isfinite(line_integrals) & torch.from_numpy(lit), line_integrals, 0.0).float()
    reasons = _counts(finite, positive, mask)
    if dead := int((finite & positive & mask & ~lit).sum()):
        reasons["without open beam"] = dead
    if ceiling is not None and (stuck := stuck_pixels(image, saturated, float(ceiling))).any():
        reasons["stuck at the ceiling"] = int((stuck & keep.numpy()).sum())
        keep = keep & ~torch.from_numpy(stuck)
    rim = aperture_rim(finite & ~positive) & keep.numpy()
    if rim.any():
        reasons["at the rim of the aperture"] = int(rim.sum())
        keep = keep & ~torch.from_numpy(rim)
    return Projections(line_integrals, keep, reasons, int(saturated.sum()))


def _counts(finite: NDArray, positive: NDArray, mask: NDArray) -> dict[str, int]:
    counts = {
        "not finite": int((~finite).sum()),
        "not positive": int((finite & ~positive).sum()),
        "in the file's mask": int((positive & ~mask).sum()),
    }
    return {reason: count for reason, count in counts.items() if count}


def _open_beam(beam: NDArray, shape: tuple[int, ...]) -> NDArray:
    """The open beam as a three-dimensional array that broadcasts to `shape`."""
    if beam.dtype.kind not in "uif" or not np.isfinite(beam).all() or beam.size == 0 or beam.max() <= 0:
        raise ValueError(f"open_beam must be positive and finite, got {np.array2string(beam, threshold=4)}")
    if beam.ndim == 1 and len(beam) == shape[0]:
        beam = beam[:, None, None]
    try:
        np.broadcast_to(beam, shape)
    except ValueError:
        raise ValueError(f"open_beam must broadcast to {shape}, got shape {beam.shape}") from None
    return beam.reshape((1,) * (3 - beam.ndim) + beam.shape)


def _dark(dark: NDArray, shape: tuple[int, ...]) -> NDArray:
    """The dark field, (1, 1, 1) or (1, rows, cols)."""
    if dark.dtype.kind not in "uif" or not np.isfinite(dark).all() or dark.size == 0 or dark.min() < 0:
        raise ValueError("dark must be finite numbers of at least 0")
    if dark.size == 1:
        return dark.reshape(1, 1, 1).astype(np.float64)
    if dark.shape[-2:] != tuple(shape) or dark.size != np.prod(shape):
        raise ValueError(f"dark must be one number or an image {tuple(shape)}, got shape {dark.shape}")
    return dark.reshape(1, *shape).astype(np.float64)


def check_views(views: Sequence[int], num_views: int) -> None:
    """Check view numbers.

    Raises:
        ValueError: There are no views, or one does not exist.
    """
    if len(views) == 0:
        raise ValueError("views must name at least one view")
    for view in views:
        if not 0 <= view < num_views:
            raise ValueError(f"there is no view {view}: the projections have views 0 to {num_views - 1}")

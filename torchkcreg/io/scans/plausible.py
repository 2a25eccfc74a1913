"""Plausibility checks: stuck pixels, raw counts, duplicate views, header against geometry, magnification."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, binary_propagation, distance_transform_edt, median_filter
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry

_RAW = 20.0  # median line integral; at this value a billionth of the beam is transmitted
_BRIGHT = -0.7  # median line integral; below it pixels have twice the open beam, more than scatter adds
_MAGNIFICATION = (1.0, 8.0)
_ALONE = 0.7  # the neighbours of a stuck pixel stay below this fraction of the saturation level
_SPACING = 0.01  # relative


def implausible_images(line_integrals: Tensor, mask: Tensor) -> list[str]:
    """Doubts about line integrals (V, rows, cols), one text each.

    Raises:
        ValueError: The values are certainly no line integrals, but intensities.
    """
    values = line_integrals[mask]
    if len(values) == 0:
        return []
    median = float(values[:: max(1, len(values) // 1_000_000)].median())
    if median > _RAW:
        raise ValueError(f"line integrals have a median of {median:.4g}: they are intensities, give their open_beam")
    doubts = []
    if median < _BRIGHT:
        doubts.append(
            f"most pixels are much brighter than the open beam (median line integral {median:.2g}): is it right?"
        )
    same = [view for view in range(1, len(mask)) if bool((line_integrals[view] == line_integrals[view - 1]).all())]
    if same and float(values.max()) > float(values.min()):
        doubts.append(f"view {same[0]} is the same image as view {same[0] - 1}: is each view there once?")
    return doubts


# Surroundings of an aperture: least share of the pixels, and thickness and rim relative to the detector's width.
_SURROUNDINGS, _THICK, _RIM = 0.01, 0.01, 0.04


def stuck_pixels(image: NDArray, saturated: NDArray[np.bool_], ceiling: float) -> NDArray[np.bool_]:
    """Defective detector pixels (V, rows, cols): isolated pixels at the saturation level in every view.

    Saturated open-beam regions, in contrast, are wide or move from view to view. With a single view, the two cannot be
    distinguished and no pixel is returned.
    """
    always = saturated.all(0)
    thin = always & ~binary_opening(always, np.ones((3, 3)))
    if len(image) < 2 or not thin.any():
        return np.zeros_like(saturated)
    dark = [median_filter(view.astype(np.float32), 5) < _ALONE * ceiling for view in image]
    return np.broadcast_to(thin & np.all(dark, axis=0), saturated.shape).copy()


def aperture_rim(unlit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (V, rows, cols) at the rim of an aperture: within 4 % of the detector's width of its unlit surroundings.

    Apertures of image intensifiers and collimators leave a rim of half-shadow and glare, which looks like metal. Their
    surroundings touch the detector's border, hold at least 1 % of its pixels and are no thin lines.

    Args:
        unlit: True for pixels without signal, (V, rows, cols).
    """
    size = min(unlit.shape[1:])
    thick, width = max(3, round(_THICK * size)), max(1, round(_RIM * size))
    rim = np.zeros_like(unlit)
    for dark, around in zip(unlit, rim, strict=True):
        if dark.mean() < _SURROUNDINGS or dark.all():
            continue
        border = np.ones_like(dark)
        border[1:-1, 1:-1] = False
        # What lies beyond the detector is taken as unlit, else opening would erode corners.
        padded = np.pad(dark, thick, mode="edge")
        solid = binary_opening(padded, np.ones((thick, thick)))[thick:-thick, thick:-thick] & dark
        outside = binary_propagation(solid & border, mask=dark)
        if outside.mean() >= _SURROUNDINGS:
            around |= (distance_transform_edt(~outside) <= width) & ~dark
    return rim


@dataclass(frozen=True)
class ImageHeader:
    """Pixel spacing, origin and axes from the header of an image file.

    Attributes:
        spacing: (dv, du) in mm.
        origin_mm: (u, v) of the centre of pixel (0, 0).
        turned: True if the direction matrix is not the identity.
    """

    spacing: tuple[float, float]
    origin_mm: tuple[float, float]
    turned: bool

    @classmethod
    def of(cls, image: sitk.Image | sitk.ImageFileReader) -> ImageHeader | None:
        """The header of an image stack or of its reader; None for the default: 1 x 1 mm, no origin, not turned."""
        (du, dv), origin = image.GetSpacing()[:2], image.GetOrigin()[:2]
        size = image.GetDimension()
        turned = not np.allclose(np.reshape(image.GetDirection(), (size, size)), np.eye(size), atol=1e-3)
        is_default = du == dv == 1.0 and origin == (0.0, 0.0) and not turned
        return None if is_default else cls((dv, du), origin, turned)

    def check_against(self, geometry: ConeBeamGeometry) -> None:
        """Warn if the pixel spacing differs from the geometry's, or if the axes are rotated or flipped."""
        expected = geometry.pixel_spacing
        if self.spacing != (1.0, 1.0) and not np.allclose(self.spacing, expected, rtol=_SPACING):
            spacing_text, expected_text = (
                " x ".join(f"{d:.4g}" for d in spacing) for spacing in (self.spacing, expected)
            )
            warnings.warn(
                f"the images' header says pixels of {spacing_text} mm, the geometry {expected_text} mm", stacklevel=3
            )
        if self.turned:
            warnings.warn(
                "the images' header turns their axes; pixels are used as stored, row 0 with the smallest v",
                stacklevel=3,
            )


def implausible_magnification(geometry: ConeBeamGeometry, points: Tensor) -> str | None:
    """Doubt about the position of an object (N, 3) between source and detector, as text; None if it is plausible."""
    depth = geometry.project(points.double())[1].median(-1).values
    ratios = geometry.detector_distances / depth
    least, most = int(ratios.argmin()), int(ratios.argmax())
    if float(ratios[least]) < _MAGNIFICATION[0]:
        return f"the object would stand behind the detector in view {least}: do pixel spacing and matrices fit, in mm?"
    if float(ratios[most]) > _MAGNIFICATION[1]:
        return f"the object would be magnified {ratios[most]:.1f} times in view {most}: are matrices and mesh in mm?"
    return None

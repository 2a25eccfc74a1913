"""DICOM: file order, X-ray images, and the nominal geometry given by the tags."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, DetectorFrames

from .series import in_order

DICOM_SUFFIXES = (".dcm", ".ima")
NEEDED = "DICOM files need pydicom: pip install 'torchkcreg[io]'"


def is_dicom(path: Path) -> bool:
    """True if a file is DICOM, by its suffix or, without a suffix, by its first bytes."""
    if path.suffix.lower() in DICOM_SUFFIXES:
        return True
    if path.suffix.strip(".0123456789") or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """DICOM files of a folder, sorted by instance number, or by the numbers in their names if it is missing.

    Raises:
        ValueError: Some instance numbers are missing or equal, but not all, or the files belong to several series.
    """
    return list(_ordered(folder))


def _ordered(folder: Path) -> dict[Path, Any]:
    """DICOM files of a folder in order, with their tags."""
    tags = {file: _tags(file) for file in in_order(filter(is_dicom, folder.iterdir()))}
    series = {_text(dataset, "SeriesInstanceUID") for dataset in tags.values()}
    if 1 < len(series) < len(tags):  # a series for each file: single exposures
        raise ValueError(f"its DICOM files belong to {len(series)} series: keep the files of one series in a folder")
    numbers = {file: _number(dataset, "InstanceNumber", 0) for file, dataset in tags.items()}
    if 1 < len(set(numbers.values())) < len(numbers):
        raise ValueError("its DICOM files do not say their order: InstanceNumber is missing or the same in some")
    return {
        file: tags[file] for file in sorted(tags, key=lambda file: numbers[file])
    }  # a stable sort: equal numbers keep the order by name


def dicom_images(path: Path) -> NDArray:
    """The frames (V, rows, cols) of a file, proportional to the X-ray intensity.

    Raises:
        ValueError: The file is damaged, in colour, compressed in an unsupported way, or processed for display.
        ImportError: pydicom is not installed.
    """
    data = _tags(path, pixels=True)
    relation = _text(data, "PixelIntensityRelationship")
    if relation not in ("", "LIN"):
        raise ValueError(
            f"its pixels are {relation} of the X-ray intensity (PixelIntensityRelationship), not in proportion to it: "
            "ask the scanner for unprocessed images"
        )
    if _number(data, "PixelIntensityRelationshipSign", 1) < 0:
        raise ValueError(
            "its pixels are larger where fewer X-rays arrive (PixelIntensityRelationshipSign): invert them"
        )
    try:
        images = np.asarray(data.pixel_array)
    except Exception as error:  # pydicom and its decoders raise various types
        raise ValueError(f"{path.name} has no pixels that can be read: {str(error).splitlines()[0]}") from error
    if (samples := _number(data, "SamplesPerPixel", 1)) != 1:
        raise ValueError(f"{path.name} has {samples:g} numbers a pixel: grey images have one")
    slope, intercept = _number(data, "RescaleSlope", 1.0), _number(data, "RescaleIntercept", 0.0)
    images = images if (slope, intercept) == (1.0, 0.0) else (images * slope + intercept).astype(np.float32)
    return images.reshape(-1, *images.shape[-2:])


def read_dicom_geometry(path: Path) -> ConeBeamGeometry:
    """The nominal geometry of an angiographic (XA) multi-frame file, or of a folder with one file per view.

    The world is that of a supine patient, with its origin at the isocentre: x to the left, y to the back, z to the
    head. At angle 0 the detector is in front of the patient. It moves to the left with a positive primary angle (LAO)
    and to the head with a positive secondary angle (CRA). The row index increases towards the feet.
    DistanceSourceToPatient is taken as the distance from source to isocentre.

    Tags hold nominal values. Real C-arms sag by millimetres; a registration's `view_motion` can estimate this.

    Raises:
        ValueError: Tags are missing or inconsistent, or images are flipped or rotated.
    """
    tags = list(_ordered(path).values()) if path.is_dir() else [_tags(path)]
    if not tags:
        raise ValueError("holds no DICOM files")
    shapes = {(int(_number(dataset, "Rows")), int(_number(dataset, "Columns")), *_spacing(dataset)) for dataset in tags}
    if len(shapes) > 1:
        raise ValueError(f"its files have pixels of different numbers or sizes: {sorted(shapes)}")
    rows, cols, *spacing = shapes.pop()
    primary, secondary = (
        torch.cat([_angles(dataset, name) for dataset in tags]).deg2rad()
        for name in ("PositionerPrimaryAngle", "PositionerSecondaryAngle")
    )
    sad, sdd = torch.cat([_distances(dataset) for dataset in tags]).T[..., None]
    sin_a, cos_a, sin_b, cos_b = primary.sin(), primary.cos(), secondary.sin(), secondary.cos()
    towards = torch.stack([sin_a * cos_b, -cos_a * cos_b, sin_b], dim=1)  # from the isocentre to the detector
    across = torch.stack([cos_a, sin_a, torch.zeros_like(sin_a)], dim=1)
    down = torch.stack([sin_a * sin_b, -cos_a * sin_b, -cos_b], dim=1)
    frames = DetectorFrames(-sad * towards, (sdd - sad) * towards, spacing[1] * across, spacing[0] * down)
    return frames.geometry((int(rows), int(cols)), angles_deg=primary.rad2deg().tolist())


def _spacing(tags: Any) -> tuple[float, float]:
    """Pixel spacing (dv, du) on the detector, mm."""
    if _text(tags, "FieldOfViewHorizontalFlip") == "YES" or _number(tags, "FieldOfViewRotation", 0) != 0:
        raise ValueError("images are flipped or turned against the detector (FieldOfView tags): undo that first")
    spacing = _numbers(tags, "ImagerPixelSpacing")
    if len(spacing) != 2 or min(spacing) <= 0:
        raise ValueError(f"ImagerPixelSpacing must be two positive numbers, got {spacing}")
    return spacing[0], spacing[1]


def _distances(tags: Any) -> Tensor:
    """Distances from the source to the isocentre and to the detector (frames, 2), mm."""
    sad, sdd = _number(tags, "DistanceSourceToPatient"), _number(tags, "DistanceSourceToDetector")
    if not 0 < sad < sdd:
        raise ValueError(f"DistanceSourceToPatient {sad:g} mm must lie between 0 and DistanceSourceToDetector {sdd:g}")
    return torch.tensor([[sad, sdd]], dtype=torch.float64).expand(int(_number(tags, "NumberOfFrames", 1)), 2)


def _angles(tags: Any, name: str) -> Tensor:
    """Angle of each frame, degrees: initial angle plus a mean step or an offset per frame (PS3.3 C.8.7.5.1.3)."""
    frames = int(_number(tags, "NumberOfFrames", 1))
    start = _number(tags, name, 0.0 if name == "PositionerSecondaryAngle" else None)
    steps = _numbers(tags, f"{name}Increment") if f"{name}Increment" in tags else [0.0]
    if len(steps) == 1:
        return start + steps[0] * torch.arange(frames, dtype=torch.float64)
    if len(steps) != frames:
        raise ValueError(f"{name}Increment has {len(steps)} values for {frames} frames")
    return start + torch.tensor(steps, dtype=torch.float64)


def _tags(path: Path, *, pixels: bool = False) -> Any:
    """The tags of a file, with or without its pixels."""
    try:
        import pydicom
    except ImportError:
        raise ImportError(NEEDED) from None
    try:
        return pydicom.dcmread(path, stop_before_pixels=not pixels)
    except Exception as error:  # pydicom, struct and decoders raise various types on damaged files
        raise ValueError(f"{path.name} is no DICOM file that can be read") from error


def _text(tags: Any, name: str) -> str:
    try:
        value = tags.get(name)
    except Exception:  # damaged values raise various types
        return "damaged"
    return "" if value is None else str(value)


def _number(tags: Any, name: str, default: float | None = None) -> float:
    if default is not None and not _text(tags, name):
        return default
    return _numbers(tags, name)[0]


def _numbers(tags: Any, name: str) -> list[float]:
    try:
        content = tags.get(name)
        values = [float(part) for part in (content if not isinstance(content, (str, int, float)) else [content])]
    except Exception:  # values are decoded on access, and damaged ones raise various types
        requirement = (name in tags and "hold numbers") or "be there"
        raise ValueError(f"DICOM tag {name} must {requirement}: give a geometry of another kind") from None
    if not values or not all(math.isfinite(value) for value in values):
        raise ValueError(f"DICOM tag {name} must hold finite numbers, got {values}")
    return values

"""Projection geometry files (JSON, RTK, DICOM, tables). The 3x4 matrix of each view defines the geometry."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.plain import finite_array, finite_number

from .files import existing_place, read_json, write_json
from .matrix_tables import SUFFIXES, read_matrix_table, write_matrix_table
from .mayacam import is_mayacam, mayacam_files, read_mayacam
from .rtk_geometry import read_rtk, write_rtk
from .scans import image_header, is_dicom, read_dicom_geometry

CONVENTION = "u = (P[0].X)/(P[2].X), v = (P[1].X)/(P[2].X); X=(x,y,z,1) in mm; u column, v row, 0-based pixel centres"
SOURCE_TOLERANCE_MM = 0.1
SDD_TOLERANCE = 0.01


def read_geometry(
    path: str | os.PathLike[str],
    *,
    projections: str | os.PathLike[str] | None = None,
    det_shape: Sequence[int] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layout: str | None = None,
) -> ConeBeamGeometry:
    """Read a cone-beam geometry from JSON, RTK XML, DICOM, MayaCam, or a table of matrices.

    JSON has the keys `rows`, `cols`, `pixel_pitch_mm` (a number, or `[dv, du]`), `views`, a list of dicts with
    `projection_matrix` (3x4, world mm to homogeneous 0-based pixels), and optionally `angle_deg` and `source` (a label)
    in every view. Redundant keys are checked against the matrices: `source_mm` or `source_z_mm` of a view must agree
    within 0.1 mm, and `sdd_mm` must agree within 1 % with the source-detector distance that follows from pixel pitch
    and matrices. Other keys are ignored.

    MayaCam 2.0 files of XMALab are one camera each, or a folder of them: see `read_mayacam`.

    DICOM files of C-arms, or a folder of them, hold the nominal geometry: see `read_dicom_geometry`. The other formats
    (`.xml`, see `read_rtk`; `.npy`, `.npz`, `.csv`, `.txt`, see `read_matrix_table`) do not define the pixels. For
    these, pixels are taken from the arguments or from the header of the projection images.

    Args:
        path: The file or DICOM folder.
        projections: Projection image file (MHA, NRRD, ...) whose header defines pixels and origin.
        det_shape: (rows, cols), needed if neither file defines them.
        pixel_spacing: (dv, du) in mm, needed if neither file defines them.
        layout: Meaning of twelve numbers per view in a table, "matrices" or "astra".

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is malformed or inconsistent, or the pixels are not defined. The message names the file,
            the view and the key.
    """
    file = existing_place(path, "geometry")
    suffix = file.suffix.lower()
    cameras = mayacam_files(file) if file.is_dir() else [file] if is_mayacam(file) else []
    if cameras:
        try:
            return read_mayacam(cameras, pixel_spacing=pixel_spacing, det_shape=det_shape)
        except ValueError as error:
            raise ValueError(f"geometry {path}: {error}") from error
    if is_dicom(file) or file.is_dir():
        try:
            return read_dicom_geometry(file)
        except ValueError as error:
            raise ValueError(f"geometry file {path}: {error}") from error
    if suffix != ".xml" and suffix not in SUFFIXES:
        content = read_json(path, "geometry")
        try:
            return geometry_from_dict(content)
        except ValueError as error:
            raise ValueError(f"geometry file {path}: {error}") from error
    header = None if projections is None else image_header(Path(projections))
    shape = det_shape or (header.shape if header else None)
    spacing = pixel_spacing or (header.pixel_spacing if header else None)
    if shape is None or spacing is None:
        raise ValueError(
            f"geometry file {path} does not say what the pixels are: give the image of the projections, or rows, "
            "columns and pixel spacing"
        )
    if suffix == ".xml":
        origin = header.origin_mm if header is not None and pixel_spacing is None else None
        return read_rtk(path, det_shape=shape, pixel_spacing=spacing, origin_mm=origin)
    try:
        return read_matrix_table(file, det_shape=shape, pixel_spacing=spacing, layout=layout)
    except ValueError as error:
        raise ValueError(f"geometry file {path}: {error}") from error


def geometry_from_dict(content: Any) -> ConeBeamGeometry:
    """The cone-beam geometry described by a dict with the keys of `read_geometry`.

    Raises:
        ValueError: A key is missing, malformed or inconsistent; the message names it.
    """
    if not isinstance(content, dict) or not isinstance(content.get("views"), list) or not content["views"]:
        raise ValueError("must be a JSON object with a list 'views' of at least one view")
    views = content["views"]
    matrices = torch.stack([_matrix(view, i) for i, view in enumerate(views)])
    spacing = _pixel_spacing(content.get("pixel_pitch_mm"))
    angles = _in_every_view(views, "angle_deg")
    sources = _in_every_view(views, "source")
    geometry = ConeBeamGeometry(
        matrices,
        (_size(content, "rows"), _size(content, "cols")),
        spacing,
        sources=None if sources is None else tuple(str(label) for label in sources),
        angles_deg=None
        if angles is None
        else tuple(finite_number(a, f"angle_deg of view {i}") for i, a in enumerate(angles)),
    )
    _check_sources(geometry, views)
    if content.get("sdd_mm") is not None:
        _check_sdd(geometry, finite_number(content["sdd_mm"], "sdd_mm", positive=True))
    return geometry


def write_geometry(path: str | os.PathLike[str], geometry: ConeBeamGeometry, *, layout: str = "matrices") -> None:
    """Write a geometry as JSON, RTK XML, or a table. `read_geometry` reads back the same numbers.

    For human readers, JSON also holds `source_mm` and `source_z_mm` of each view, and, if they are equal in all views,
    `sad_mm` (distance of the source from the z axis) and `sdd_mm`. Tables hold matrices, or ASTRA's vectors if `layout`
    is "astra".
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".xml":
        write_rtk(path, geometry)
    elif suffix in SUFFIXES:
        write_matrix_table(Path(path), geometry, layout=layout)
    else:
        write_json(path, geometry_to_dict(geometry))


def geometry_to_dict(geometry: ConeBeamGeometry) -> dict[str, Any]:
    """The geometry as plain data, with the keys of `read_geometry`."""
    sources_mm = geometry.source_positions.detach().cpu().double()
    dv, du = (float(step) for step in geometry.pixel_spacing)
    content: dict[str, Any] = {
        "convention": CONVENTION,
        "rows": int(geometry.det_shape[0]),
        "cols": int(geometry.det_shape[1]),
        "pixel_pitch_mm": dv if dv == du else [dv, du],
    }
    for key, lengths in (("sad_mm", sources_mm[:, :2].norm(dim=-1)), ("sdd_mm", geometry.detector_distances)):
        if float(lengths.max() - lengths.min()) < 1e-6 * float(lengths.max()):
            content[key] = round(float(lengths.mean()), 6)
    content["views"] = [
        {
            **({} if geometry.angles_deg is None else {"angle_deg": float(geometry.angles_deg[i])}),
            **({} if geometry.sources is None else {"source": str(geometry.sources[i])}),
            "source_z_mm": float(sources_mm[i, 2]),
            "source_mm": sources_mm[i].tolist(),
            "projection_matrix": matrix.tolist(),
        }
        for i, matrix in enumerate(geometry.projection_matrices.detach().cpu().double())
    ]
    return content


def _matrix(view: Any, i: int) -> Tensor:
    if not isinstance(view, dict) or "projection_matrix" not in view:
        raise ValueError(f"view {i} has no projection_matrix")
    matrix = finite_array(view["projection_matrix"], (3, 4), f"projection_matrix of view {i}")
    rows = matrix[:, :3] / matrix[:, :3].norm(dim=-1, keepdim=True)
    if not float(torch.linalg.det(rows).abs()) > 1e-9:
        raise ValueError(f"projection_matrix of view {i} is singular: it has no source position")
    return matrix


def _size(content: dict[str, Any], key: str) -> int:
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{key} must be a positive whole number of pixels, got {value!r}")
    return value


def _pixel_spacing(pitch: Any) -> tuple[float, float]:
    steps = pitch if isinstance(pitch, list) else [pitch, pitch]
    if len(steps) != 2:
        raise ValueError(f"pixel_pitch_mm must be a number or [dv, du], got {pitch!r}")
    return (
        finite_number(steps[0], "pixel_pitch_mm", positive=True),
        finite_number(steps[1], "pixel_pitch_mm", positive=True),
    )


def _in_every_view(views: list[dict[str, Any]], key: str) -> list[Any] | None:
    """The key's value in each view; None if no view has it."""
    missing = [i for i, view in enumerate(views) if view.get(key) is None]
    if len(missing) == len(views):
        return None
    if missing:
        raise ValueError(f"{key} must be in every view or in none, but view {missing[0]} lacks it")
    return [view[key] for view in views]


def _check_sources(geometry: ConeBeamGeometry, views: list[dict[str, Any]]) -> None:
    for i, (view, derived) in enumerate(zip(views, geometry.source_positions.double())):
        if view.get("source_mm") is not None:
            stated = finite_array(view["source_mm"], (3,), f"source_mm of view {i}")
            distance = float((stated - derived).norm())
            if distance > SOURCE_TOLERANCE_MM:
                raise ValueError(
                    f"source_mm of view {i} is {distance:.3g} mm from the source of its projection_matrix, "
                    f"{[round(x, 3) for x in derived.tolist()]}"
                )
        if view.get("source_z_mm") is not None:
            z = finite_number(view["source_z_mm"], f"source_z_mm of view {i}")
            if abs(z - float(derived[2])) > SOURCE_TOLERANCE_MM:
                raise ValueError(f"source_z_mm of view {i} is {z:g}, its projection_matrix says {float(derived[2]):g}")


def _check_sdd(geometry: ConeBeamGeometry, sdd_mm: float) -> None:
    for i, derived in enumerate(geometry.detector_distances.tolist()):
        if abs(derived - sdd_mm) > SDD_TOLERANCE * sdd_mm:
            raise ValueError(
                f"sdd_mm is {sdd_mm:g}, but by pixel_pitch_mm and the projection_matrix of view {i} it is {derived:.4g}"
            )

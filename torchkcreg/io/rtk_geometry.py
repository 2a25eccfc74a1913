"""Reading and writing of RTK's `ThreeDCircularProjectionGeometry` files (XML)."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from xml.sax.saxutils import escape

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.geometry.frames import DetectorFrames

from .files import existing_file, write_text

ROOT = "RTKThreeDCircularGeometry"
LARGEST = 1 << 26  # file size in bytes, about half a million views
AGREEMENT = 1e-3  # tolerance between a view's parameters and its matrix, relative to the largest entry
PARAMETERS = (  # of a view; 0 if missing
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "GantryAngle",
    "OutOfPlaneAngle",
    "InPlaneAngle",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
    "SourceOffsetX",
    "SourceOffsetY",
)


def read_rtk(
    path: str | os.PathLike[str],
    *,
    det_shape: Sequence[int],
    pixel_spacing: Sequence[float],
    origin_mm: Sequence[float] | None = None,
) -> ConeBeamGeometry:
    """The geometry of an RTK XML file, in RTK's world coordinates: the gantry rotates about y.

    RTK's matrices map to mm on the detector. Their relation to pixels is given by the header of the projections: the
    centre of pixel (0, 0) is the image's origin. Use `geometry.moved` to change the world, for example to one whose z
    is the gantry's axis.

    Args:
        path: The file.
        det_shape: (rows, cols) of the projections.
        pixel_spacing: (dv, du) of the projections, mm.
        origin_mm: (u, v) of the centre of pixel (0, 0), the origin of the projections' image. If None, the middle of
            the detector is at 0: the origin is `-(n - 1) / 2` pixels, as in RTK's own simulations.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is no RTK geometry, describes parallel rays or a cylindrical detector, or the matrix of a
            view does not agree with its parameters.
    """
    file = existing_file(path, "geometry")
    try:
        if file.stat().st_size > LARGEST:
            raise ValueError(f"is larger than {LARGEST} bytes")
        text = file.read_text(encoding="utf-8", errors="replace")
        if "<!ENTITY" in text:
            raise ValueError("must not define entities")
        return _of(ET.fromstring(text), det_shape, pixel_spacing, origin_mm)
    except (ET.ParseError, ValueError) as error:
        raise ValueError(f"geometry file {path}: {error}") from error


def _of(
    root: ET.Element, det_shape: Sequence[int], pixel_spacing: Sequence[float], origin_mm: Sequence[float] | None
) -> ConeBeamGeometry:
    if root.tag != ROOT:
        raise ValueError(f"must be a {ROOT}, got {root.tag}")
    if _number(root, "RadiusCylindricalDetector", 0.0) != 0:
        raise ValueError("a cylindrical detector has no projection matrices")
    shared = {name: _number(root, name, 0.0) for name in PARAMETERS}
    matrices, angles = [], []
    for view, element in enumerate(root.iter("Projection")):
        parameters = {name: _number(element, name, value) for name, value in shared.items()}
        if not parameters["SourceToDetectorDistance"] > 0:
            raise ValueError(f"view {view}: SourceToDetectorDistance must be positive, parallel rays are not read")
        matrix = rtk_matrix(parameters)
        written = element.find("Matrix")
        if written is not None:
            values = [_finite(word, "Matrix") for word in (written.text or "").split()]
            if len(values) != 12:
                raise ValueError(f"view {view}: Matrix must have 12 numbers, got {len(values)}")
            given = torch.tensor(values, dtype=torch.float64).reshape(3, 4)
            scale = float((given * matrix).sum() / matrix.square().sum())
            if not float((given / (scale or math.nan) - matrix).abs().max()) < AGREEMENT * float(matrix.abs().max()):
                raise ValueError(f"view {view}: Matrix is not that of its angles, distances and offsets")
        matrices.append(matrix)
        angles.append(parameters["GantryAngle"])
    if not matrices:
        raise ValueError("has no Projection")
    rows, cols = det_shape
    dv, du = pixel_spacing
    u0, v0 = origin_mm if origin_mm is not None else (-(cols - 1) / 2 * du, -(rows - 1) / 2 * dv)
    to_pixels = torch.tensor([[1 / du, 0, -u0 / du], [0, 1 / dv, -v0 / dv], [0, 0, 1]], dtype=torch.float64)
    return ConeBeamGeometry(to_pixels @ torch.stack(matrices), det_shape, pixel_spacing, angles_deg=angles)


def rtk_matrix(parameters: dict[str, float]) -> Tensor:
    """RTK's matrix (3, 4) of a view: world mm to mm on the detector.

    It is `shift(source offset - projection offset) magnify(-SDD, -SID) shift(-source offset) rotate`. The rotation is
    Rz(-in-plane angle) Rx(-out-of-plane angle) Ry(-gantry angle).
    """
    gantry, out, inside = (
        math.radians(parameters[name]) for name in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle")
    )
    sx, sy = parameters["SourceOffsetX"], parameters["SourceOffsetY"]
    px, py = parameters["ProjectionOffsetX"], parameters["ProjectionOffsetY"]
    sid, sdd = parameters["SourceToIsocenterDistance"], parameters["SourceToDetectorDistance"]
    rotation = torch.eye(4, dtype=torch.float64)
    rotation[:3, :3] = _about(2, -inside) @ _about(0, -out) @ _about(1, -gantry)
    from_source = torch.eye(4, dtype=torch.float64)
    from_source[0, 3], from_source[1, 3] = -sx, -sy
    magnified = torch.tensor([[-sdd, 0, 0, 0], [0, -sdd, 0, 0], [0, 0, 1, -sid]], dtype=torch.float64)
    shift = torch.tensor([[1, 0, sx - px], [0, 1, sy - py], [0, 0, 1]], dtype=torch.float64)
    return shift @ magnified @ from_source @ rotation


def _about(axis: int, angle: float) -> Tensor:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
    return matrix


def write_rtk(path: str | os.PathLike[str], geometry: ConeBeamGeometry) -> None:
    """Write a geometry as RTK XML, for projections whose middle is at 0: origin `-(n - 1) / 2` pixels.

    Raises:
        ValueError: Rows and columns are not orthogonal, or the detector is mirrored compared with RTK's convention:
            reverse the rows of images and geometry.
    """
    views = [_parameters(*vectors) for vectors in zip(*vars(DetectorFrames.of(geometry)).values(), strict=True)]
    lines = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>", f'<{ROOT} version="3">']
    for parameters in views:
        matrix = "\n".join("      " + " ".join(f"{x:.15g}" for x in row) for row in rtk_matrix(parameters).tolist())
        named = [f"    <{escape(name)}>{value:.15g}</{escape(name)}>" for name, value in parameters.items()]
        lines += ["  <Projection>", *named, "    <Matrix>", matrix, "    </Matrix>", "  </Projection>"]
    write_text(path, "\n".join([*lines, f"</{ROOT}>", ""]))


def _parameters(source: Tensor, center: Tensor, across: Tensor, down: Tensor) -> dict[str, float]:
    u, v = (vector / vector.norm() for vector in (across, down))
    normal = torch.linalg.cross(u, v)
    if float((u @ v).abs()) > 1e-6:
        raise ValueError("RTK has rows and columns at right angles only")
    if float((source - center) @ normal) <= 0:
        raise ValueError("RTK has no mirror images: turn around the rows of images and geometry")
    turn = torch.stack([u, v, normal])  # rotation from the world to RTK's frame, in which the source is towards +z
    # turn = Rz(-inside) Rx(-out) Ry(-gantry)
    out = math.asin(max(-1.0, min(1.0, -float(turn[2, 1]))))
    gantry = math.atan2(float(turn[2, 0]), float(turn[2, 2]))
    inside = math.atan2(float(turn[0, 1]), float(turn[1, 1]))
    sx, sy, sid = (turn @ source).tolist()
    px, py, depth = (turn @ center).tolist()
    values = (sid, sid - depth, math.degrees(gantry), math.degrees(out), math.degrees(inside), px, py, sx, sy)
    return dict(zip(PARAMETERS, values, strict=True))


def _number(element: ET.Element, name: str, default: float) -> float:
    child = element.find(name)
    return default if child is None else _finite(child.text, name)


def _finite(text: str | None, name: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {text!r}")
    return value

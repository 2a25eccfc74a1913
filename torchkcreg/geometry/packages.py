"""Conversion of geometries from and to other packages: ASTRA, LEAP and TIGRE."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .circular import gantry_axes
from .cone_beam import ConeBeamGeometry
from .frames import DetectorFrames


def from_astra(vectors: Tensor, det_shape: Sequence[int]) -> ConeBeamGeometry:
    """Geometry from ASTRA's `cone_vec`, rows of source, detector centre, column step and row step in mm.

    ASTRA's lengths are in units of its voxels; convert them to mm first. Its sinograms are (rows, V, cols), so images
    are `sinogram.swapaxes(0, 1)`.

    Args:
        vectors: ASTRA's vectors, (V, 12).
        det_shape: Detector size (rows, cols).
    """
    vectors = torch.as_tensor(vectors).double()
    if vectors.dim() != 2 or vectors.shape[1] != 12:
        raise ValueError(f"cone_vec must have shape (V, 12), got {tuple(vectors.shape)}")
    return DetectorFrames(*vectors.split(3, dim=1)).geometry(det_shape)


def to_astra(geometry: ConeBeamGeometry) -> Tensor:
    """ASTRA's `cone_vec` (V, 12) of a geometry, lengths in mm; see `from_astra`.

    >>> from torchkcreg.geometry import circular_geometry
    >>> views = circular_geometry([0.0], sad=400, sdd=600, det_shape=(5, 5), pixel_spacing=(2.0, 1.0))
    >>> bool(torch.allclose(from_astra(to_astra(views), (5, 5)).projection_matrices, views.projection_matrices))
    True
    """
    frames = DetectorFrames.of(geometry)
    return torch.cat([frames.sources, frames.centers, frames.col_steps, frames.row_steps], dim=1)


def from_leap(
    source_positions: Tensor,
    module_centers: Tensor,
    row_vectors: Tensor,
    col_vectors: Tensor,
    *,
    det_shape: Sequence[int],
    pixel_spacing: Sequence[float],
) -> ConeBeamGeometry:
    """Geometry from the parameters of LEAP's `set_modularbeam`; all vectors (V, 3) in mm.

    Args:
        source_positions: Focal spots.
        module_centers: Centres of the detectors.
        row_vectors: Unit vectors of increasing row index.
        col_vectors: Unit vectors of increasing column index.
        det_shape: (numRows, numCols).
        pixel_spacing: (pixelHeight, pixelWidth), mm.
    """
    positions, centers, down, across = (
        torch.as_tensor(x).double() for x in (source_positions, module_centers, row_vectors, col_vectors)
    )
    return DetectorFrames(positions, centers, pixel_spacing[1] * across, pixel_spacing[0] * down).geometry(det_shape)


def to_leap(geometry: ConeBeamGeometry) -> dict[str, Tensor]:
    """Vectors (V, 3) of LEAP's modular beam, keyed by the argument names of `from_leap`."""
    frames = DetectorFrames.of(geometry)
    return {
        "source_positions": frames.sources,
        "module_centers": frames.centers,
        "row_vectors": torch.nn.functional.normalize(frames.row_steps, dim=-1),
        "col_vectors": torch.nn.functional.normalize(frames.col_steps, dim=-1),
    }


def from_leap_cone(
    num_rows: int,
    num_cols: int,
    pixel_height: float,
    pixel_width: float,
    center_row: float,
    center_col: float,
    phis: Sequence[float] | Tensor,
    sod: float,
    sdd: float,
    *,
    tau: float = 0.0,
    tilt_angle: float = 0.0,
) -> ConeBeamGeometry:
    """Geometry from the parameters of LEAP's `set_conebeam` (flat detector), without the number of angles.

    LEAP's source is at `sod (sin phi, -cos phi, 0)`; its row index increases with z.

    Args:
        num_rows: Detector rows.
        num_cols: Detector columns.
        pixel_height: Row spacing in mm.
        pixel_width: Column spacing in mm.
        center_row: Row hit by the central ray.
        center_col: Column hit by the central ray.
        phis: Gantry angles (V,) in degrees.
        sod: Distance from source to axis, mm.
        sdd: Distance from source to detector, mm.
        tau: Lateral distance of the rotation axis from the central ray, mm.
        tilt_angle: Rotation of the detector about the central ray, degrees.

    >>> views = from_leap_cone(5, 5, 1.0, 1.0, 2.0, 2.0, [0.0], 400.0, 600.0)
    >>> [round(float(x)) for x in views.source_positions[0]]
    [0, -400, 0]
    """
    degrees = torch.as_tensor(phis).double().reshape(-1)
    along, across, up = gantry_axes(torch.deg2rad(degrees) - math.pi / 2)
    tilt = math.radians(tilt_angle)
    columns = math.cos(tilt) * across + math.sin(tilt) * up
    rows = math.cos(tilt) * up - math.sin(tilt) * across
    beside = -tau * across
    middle = ((num_cols - 1) / 2 - center_col) * pixel_width * columns
    middle = middle + ((num_rows - 1) / 2 - center_row) * pixel_height * rows
    frames = DetectorFrames(
        sod * along + beside, (sod - sdd) * along + beside + middle, pixel_width * columns, pixel_height * rows
    )
    return frames.geometry((num_rows, num_cols), angles_deg=degrees.tolist())


def from_tigre(geo: Any, angles: Sequence[float] | Tensor) -> ConeBeamGeometry:
    """Geometry from a `tigre.geometry` of mode "cone" and its angles; TIGRE itself is not needed.

    TIGRE's source is at `DSO (cos a, sin a, 0)`; its projections (V, rows, cols) can be used as they are. Distances
    and offsets are one for all views or one per view.

    Args:
        geo: Object with TIGRE's attributes: DSD, DSO, nDetector (V, U), dDetector (V, U), and optionally offOrigin
            (Z, Y, X), offDetector (V, U) and COR, all in mm.
        angles: Gantry angles (V,) in radians.

    Raises:
        ValueError: The mode is not "cone", or the detector is rotated (`rotDetector`): use `DetectorFrames` for that.

    >>> from types import SimpleNamespace
    >>> geo = SimpleNamespace(mode="cone", DSD=600, DSO=400, nDetector=(5, 5), dDetector=(2.0, 1.0))
    >>> views = from_tigre(geo, [math.pi / 2])
    >>> [round(float(x)) for x in views.source_positions[0]]
    [0, 400, 0]
    """
    if getattr(geo, "mode", "cone") != "cone":
        raise ValueError(f"geometry must be of mode cone, got {geo.mode}")
    radians = torch.as_tensor(angles).double()
    if radians.dim() != 1:
        raise ValueError(f"angles must have shape (V,), one rotation about z per view, got {tuple(radians.shape)}")

    def each(name: str, size: int) -> Tensor:
        value = torch.as_tensor(getattr(geo, name, 0.0)).double()
        return value.reshape(-1, size if value.numel() >= size else 1).expand(len(radians), size)

    if bool(each("rotDetector", 3).any()):
        raise ValueError("a rotated detector (rotDetector) is not supported: give its vectors to DetectorFrames")
    along, across, up = gantry_axes(radians)
    dso, dsd, axis = each("DSO", 1), each("DSD", 1), each("COR", 1)
    shift_v, shift_u = each("offDetector", 2).split(1, dim=1)
    beside = axis * across - each("offOrigin", 3).flip(1)
    dv, du = (float(step) for step in geo.dDetector)
    frames = DetectorFrames(
        dso * along + beside, (dso - dsd) * along + beside + shift_u * across + shift_v * up, du * across, dv * up
    )
    rows, cols = (int(n) for n in geo.nDetector)
    return frames.geometry((rows, cols), angles_deg=torch.rad2deg(radians).tolist())

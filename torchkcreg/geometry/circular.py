"""Projection matrices of a gantry that rotates about the z axis, and of sources and detectors given as vectors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .cone_beam import ConeBeamGeometry


def matrices_from_frames(
    sources: Tensor,
    det_centers: Tensor,
    col_axes: Tensor,
    row_axes: Tensor,
    *,
    det_shape: Sequence[int],
    pixel_spacing: Sequence[float],
) -> Tensor:
    """Projection matrices (V, 3, 4), float64, of flat detectors given by world vectors (V, 3) in mm.

    Args:
        sources: Positions of the focal spots.
        det_centers: Positions of the detectors' centres, that is, of pixel `((cols - 1)/2, (rows - 1)/2)`.
        col_axes: Unit vectors of increasing column index u.
        row_axes: Unit vectors of increasing row index v; not parallel to the column axes.
        det_shape: (rows, cols).
        pixel_spacing: (dv, du) in mm.

    The ray to a pixel is `center - source + (u - u_c) du a + (v - v_c) dv b`: a linear map of (u, v, 1). M is its
    inverse up to scale.
    """
    columns = [axis.double() * step for axis, step in ((col_axes, pixel_spacing[1]), (row_axes, pixel_spacing[0]))]
    u_center, v_center = (det_shape[1] - 1) / 2, (det_shape[0] - 1) / 2
    corner = det_centers.double() - sources.double() - u_center * columns[0] - v_center * columns[1]
    inverse = torch.linalg.inv(torch.stack([columns[0], columns[1], corner], dim=-1))
    return torch.cat([inverse, -inverse @ sources.double().unsqueeze(-1)], dim=-1)


def gantry_axes(radians: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors (V, 3) at gantry angles (V,): from the z axis towards the source, along its motion, and along +z."""
    zero = torch.zeros_like(radians)
    radial = torch.stack([radians.cos(), radians.sin(), zero], dim=-1)
    along = torch.stack([-radians.sin(), radians.cos(), zero], dim=-1)
    return radial, along, radial.new_tensor([0.0, 0.0, 1.0]).expand_as(radial)


def circular_geometry(
    angles_deg: Sequence[float],
    *,
    sad: float,
    sdd: float,
    det_shape: Sequence[int],
    pixel_spacing: Sequence[float],
    source_z_mm: float | Sequence[float] = 0.0,
    det_offset_mm: Sequence[float] = (0.0, 0.0),
    sources: Sequence[str] | None = None,
) -> ConeBeamGeometry:
    """Geometry of a gantry rotating about z: at angle b the source is at `(sad cos b, sad sin b, z_s)`.

    The detector's centre is at `-(sdd - sad) (cos b, sin b, 0)`, u runs along `(-sin b, cos b, 0)` and v along +z.

    Args:
        angles_deg: Gantry angles, one per view.
        sad: Distance from source to rotation axis in mm.
        sdd: Distance from source to detector in mm.
        det_shape: (rows, cols).
        pixel_spacing: (dv, du) in mm.
        source_z_mm: Height of the source above the plane z = 0; one number, or one per view.
        det_offset_mm: Shift (along v, along u) of the detector from its centred position.
        sources: Name of each view's source.

    Raises:
        ValueError: Not 0 < sad < sdd, or counts that do not match.

    >>> circular_geometry(range(0, 360, 90), sad=404, sdd=538, det_shape=(64, 32), pixel_spacing=(2.0, 2.0))
    ConeBeamGeometry(num_views=4, det_shape=(64, 32), pixel_spacing=(2, 2))
    """
    if not 0 < sad < sdd:
        raise ValueError(f"sad and sdd must satisfy 0 < sad < sdd, got {sad} and {sdd}")
    degrees = [float(angle) for angle in angles_deg]
    if not degrees:
        raise ValueError("angles_deg must hold at least one angle")
    angles = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    heights = torch.as_tensor(source_z_mm, dtype=torch.float64)
    if heights.ndim > 1 or heights.numel() not in (1, len(degrees)):
        raise ValueError(f"source_z_mm must be one number or one for each of {len(degrees)} views, got {source_z_mm}")
    radial, col_axes, row_axes = gantry_axes(angles)
    matrices = matrices_from_frames(
        sad * radial + heights.expand_as(angles)[:, None] * row_axes,
        -(sdd - sad) * radial + det_offset_mm[0] * row_axes + det_offset_mm[1] * col_axes,
        col_axes,
        row_axes,
        det_shape=det_shape,
        pixel_spacing=pixel_spacing,
    )
    return ConeBeamGeometry(matrices, det_shape, pixel_spacing, sources=sources, angles_deg=degrees)

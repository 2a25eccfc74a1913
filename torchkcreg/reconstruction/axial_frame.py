"""The virtual detector on which the FDK formula holds: through the axis of rotation, facing the source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torchkcreg.geometry import ConeBeamGeometry, matrices_from_frames

ALIGNED_PX = 0.01


@dataclass(frozen=True)
class AxialFrame:
    """Source and virtual detector of each view, with the world's z axis as axis of rotation.

    Attributes:
        angles: (V,) gantry angles of the sources, radians.
        radii: (V,) source-to-axis distances, mm.
        heights: (V,) heights of the sources, mm.
        to_virtual: (V, 3, 3) homographies from pixels (u, v, 1) to homogeneous positions (p, zeta) in mm on the virtual
            detector, p across and zeta up from the central ray.
    """

    angles: Tensor
    radii: Tensor
    heights: Tensor
    to_virtual: Tensor


def axial_frame(geometry: ConeBeamGeometry) -> AxialFrame:
    """Frame of a geometry whose sources rotate about the world's z axis.

    If the gantry rotates about another axis, align it first with `geometry.moved`.

    Raises:
        ValueError: If a source lies on the axis of rotation.
    """
    sources = geometry.source_positions.double()
    radii = sources[:, :2].norm(dim=1)
    if bool((radii < 1e-6).any()):
        raise ValueError(
            f"view {int(radii.argmin())} has its source on the axis of rotation (the world's z axis): if the gantry "
            "rotates about another axis, such as y in RTK's world, give --gantry-axis to torchkcreg convert"
        )
    across, up, inward = _axes(sources, radii)
    frame = torch.stack([radii[:, None] * across, radii[:, None] * up, inward], dim=1)
    to_virtual = frame @ torch.linalg.inv(geometry.projection_matrices[:, :, :3])
    return AxialFrame(torch.atan2(sources[:, 1], sources[:, 0]), radii, sources[:, 2], to_virtual)


def _axes(sources: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors (V, 3): across (towards growing angle), up, and from the source to the axis."""
    zeros, ones = torch.zeros_like(radii), torch.ones_like(radii)
    cosine, sine = sources[:, 0] / radii, sources[:, 1] / radii
    return (
        torch.stack([-sine, cosine, zeros], dim=1),
        torch.stack([zeros, zeros, ones], dim=1),
        torch.stack([-cosine, -sine, zeros], dim=1),
    )


def is_aligned(frame: AxialFrame, det_shape: tuple[int, int]) -> bool:
    """True if rows and columns are parallel to the virtual detector's to within a hundredth of a pixel."""
    corners = _corners(det_shape).to(frame.to_virtual)
    exact = _apply(frame.to_virtual, corners)
    linear = frame.to_virtual / frame.to_virtual[:, 2:, 2:]
    pitch = torch.stack([linear[:, 0, 0].abs(), linear[:, 1, 1].abs()], dim=1)
    middle = _apply(frame.to_virtual, corners.mean(0, keepdim=True))
    diagonal = torch.stack([linear[:, 0, 0], linear[:, 1, 1]], dim=1)
    scaled = middle + diagonal[:, None] * (corners - corners.mean(0))[None, :, :2]
    return bool((((exact - scaled) / pitch[:, None]).abs() < ALIGNED_PX).all())


def columns_and_rows(frame: AxialFrame, det_shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Positions of an aligned detector's columns (V, cols) and rows (V, rows) on the virtual detector, mm."""
    linear = frame.to_virtual / frame.to_virtual[:, 2:, 2:]
    u = torch.arange(det_shape[1], dtype=torch.float64, device=linear.device)
    v = torch.arange(det_shape[0], dtype=torch.float64, device=linear.device)
    return linear[:, 0, :1] * u + linear[:, 0, 2:], linear[:, 1, 1:2] * v + linear[:, 1, 2:]


def rectified(geometry: ConeBeamGeometry) -> tuple[ConeBeamGeometry, Callable[[Tensor, Sequence[int]], Tensor]]:
    """Geometry of the virtual detectors, and a function that resamples images (..., v, rows, cols) of views onto them.

    Needed for tilted detectors, because FDK filters along lines perpendicular to the axis. The virtual detectors have
    the mean pixel size of the real ones and are large enough to contain all of them. Outside the real detector, images
    are extended with their border pixels.
    """
    frame = axial_frame(geometry)
    corners = _apply(frame.to_virtual, _corners(geometry.det_shape).to(frame.to_virtual))
    low, high = corners.amin((0, 1)), corners.amax((0, 1))
    rows, cols = geometry.det_shape
    sides = (corners[:, [1, 2]] - corners[:, [0, 0]]).norm(dim=-1).mean(0)  # along u, along v
    pitch = torch.stack([sides[0] / max(cols - 1, 1), sides[1] / max(rows - 1, 1)])
    counts = [int(n) for n in ((high - low) / pitch).round().long() + 1]
    p = low[0] + pitch[0] * torch.arange(counts[0], dtype=torch.float64, device=low.device)
    zeta = low[1] + pitch[1] * torch.arange(counts[1], dtype=torch.float64, device=low.device)
    virtual = torch.stack([*torch.meshgrid(p, zeta, indexing="xy"), torch.ones(counts[::-1]).to(p)], dim=-1)
    back = torch.linalg.inv(frame.to_virtual)

    def resampled(images: Tensor, views: Sequence[int]) -> Tensor:
        images_out = []
        for number, view in enumerate(views):
            pixels = virtual @ back[view].mT
            size = pixels.new_tensor([cols, rows])
            places = (2 * pixels[..., :2] / pixels[..., 2:] + 1) / size - 1
            image = images[..., number, :, :].reshape(1, -1, rows, cols)
            sampled = grid_sample(
                image, places[None].to(image), mode="bilinear", padding_mode="border", align_corners=False
            )
            images_out.append(sampled.reshape(*images.shape[:-3], *counts[::-1]))
        return torch.stack(images_out, dim=-3)

    return _virtual_geometry(geometry, frame, low, high, pitch, counts), resampled


def _virtual_geometry(
    geometry: ConeBeamGeometry, frame: AxialFrame, low: Tensor, high: Tensor, pitch: Tensor, counts: list[int]
) -> ConeBeamGeometry:
    sources = geometry.source_positions.double()
    across, up, _ = _axes(sources, frame.radii)
    last = low + pitch * (pitch.new_tensor(counts) - 1)
    center = (low + last) / 2
    det_centers = sources * torch.tensor([0.0, 0.0, 1.0]).to(sources) + center[0] * across + center[1] * up
    spacing = (float(pitch[1]), float(pitch[0]))
    det_shape = (counts[1], counts[0])
    matrices = matrices_from_frames(sources, det_centers, across, up, det_shape=det_shape, pixel_spacing=spacing)
    return ConeBeamGeometry(matrices, det_shape, spacing, sources=geometry.sources, angles_deg=geometry.angles_deg)


def _corners(det_shape: tuple[int, int]) -> Tensor:
    """Centres (4, 3) of the corner pixels: first, end of u, end of v, opposite."""
    rows, cols = float(det_shape[0] - 1), float(det_shape[1] - 1)
    return torch.tensor([[0.0, 0.0, 1.0], [cols, 0.0, 1.0], [0.0, rows, 1.0], [cols, rows, 1.0]], dtype=torch.float64)


def _apply(homographies: Tensor, pixels: Tensor) -> Tensor:
    """Positions (V, n, 2) to which the homographies map homogeneous pixels (n, 3)."""
    moved = pixels @ homographies.mT
    return moved[..., :2] / moved[..., 2:]

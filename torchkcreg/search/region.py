"""Where an implant may be: the place that the views are aimed at, and the views that tell poses apart."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry

_LIKELY_DEPTH = 0.65  # of the distance from source to detector
_PLAUSIBLE_DEPTHS = (0.3, 0.95)


def aimed_at(geometry: ConeBeamGeometry) -> Tensor:
    """World point (3,), mm, that the views are aimed at: nearest to all principal rays.

    Principal rays are perpendicular to the detector, so a cropped image does not move them. If they meet nowhere
    between the sources and the detectors, the point lies at 0.65 of the way of the mean ray.
    """
    matrices, sources = geometry.projection_matrices, geometry.source_positions
    rays = torch.nn.functional.normalize(matrices[:, 2, :3], dim=-1)
    across = torch.eye(3, dtype=rays.dtype, device=rays.device) - rays[:, :, None] * rays[:, None, :]
    mean_source = sources.mean(0)
    offset = (across @ (sources - mean_source)[..., None]).mean(0)
    point = mean_source + torch.linalg.lstsq(across.mean(0), offset).solution[:, 0]
    depths = (matrices[:, 2, :3] @ point + matrices[:, 2, 3]) / geometry.detector_distances
    low, high = _PLAUSIBLE_DEPTHS
    if bool(((depths > low) & (depths < high)).all()):
        return point
    return (sources + _LIKELY_DEPTH * geometry.detector_distances[:, None] * rays).mean(0)


def spread_views(geometry: ConeBeamGeometry, number: int, *, opposite: bool = False) -> list[int]:
    """Up to `number` views from directions as different as possible, starting with the middle one, in order.

    Args:
        geometry: All views.
        number: Number of views.
        opposite: True if opposite directions are as good as different ones; they show the same outline.
    """
    rays = torch.nn.functional.normalize(geometry.source_positions - aimed_at(geometry), dim=-1)
    chosen = [geometry.num_views // 2]
    while len(chosen) < min(number, geometry.num_views):
        cosines = rays @ rays[chosen].mT
        nearest = (cosines if opposite else cosines.abs()).amax(-1)
        nearest[chosen] = 2.0
        chosen.append(int(nearest.argmin()))
    return sorted(chosen)

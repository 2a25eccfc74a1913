"""Geometries that are off as real scanners' are: a detector that sags, a source that wanders, a limb that moves."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.scene import ViewMotions

ERRORS = {"detector": 0.3, "source": 0.2, "limb": 0.3}  # pixels, mm, mm


def wrong_geometry(geometry: ConeBeamGeometry, nodes: Tensor, error: str, seed: int) -> ConeBeamGeometry:
    """The geometry that a registration is told where the scan was made with another.

    Errors are independent in each view and sum to nothing over all: what views have in common moves the implant, which
    no image tells from a scanner that stands elsewhere.

    Args:
        geometry: Of the images.
        nodes: World positions (N, 3) of the implant.
        error: "detector": 0.3 pixels along rows and columns; "source": 0.2 mm along each axis; "limb": a rigid motion
            between views that moves nodes by 0.3 mm, root mean square; "all" of them; "none".
        seed: Of the random numbers.

    Raises:
        ValueError: If there is no such error.
    """
    if error not in ("none", "all", *ERRORS):
        raise ValueError(f"error must be one of none, {', '.join(ERRORS)}, all, got {error!r}")
    rng = np.random.default_rng([seed, 77])
    number = geometry.num_views
    drawn = [torch.from_numpy(rng.normal(size=(number, n))) for n in (2, 3, 6)]
    pixels, shifts, motions = (x - x.mean(0) for x in drawn)
    matrices = geometry.projection_matrices.clone()
    if error in ("detector", "all"):
        matrices[:, :2] += ERRORS["detector"] * pixels[..., None] * matrices[:, 2:]
    if error in ("source", "all"):
        distances = geometry.detector_distances.tolist()
        moved = zip(matrices, distances, ERRORS["source"] * shifts, strict=True)
        matrices = torch.stack([with_source(*view) for view in moved])
    if error in ("limb", "all"):
        limb = ViewMotions(nodes, number, 1.0)
        limb.values.copy_(ERRORS["limb"] / math.sqrt(5) * motions)  # about its long axis a plate hardly moves
        matrices = matrices @ limb.matrices()
    return ConeBeamGeometry(
        matrices,
        geometry.det_shape,
        geometry.pixel_spacing,
        sources=geometry.sources,
        angles_deg=geometry.angles_deg,
    )


def with_source(matrix: Tensor, distance: float, shift: Tensor) -> Tensor:
    """The projection matrix (3, 4) after its source has moved by (3,) mm while the detector, so far off, stays."""
    inverse = torch.linalg.inv(matrix[:, :3])
    source = shift - inverse @ matrix[:, 3]
    inverse[:, 2] -= shift / distance
    rotated = torch.linalg.inv(inverse)
    return torch.cat([rotated, -(rotated @ source)[:, None]], dim=1)

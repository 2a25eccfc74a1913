"""Views, grids and an ellipsoid for the tests of the voxel projector."""

from __future__ import annotations

import torch
from drr_bodies import camera, rays, rotation
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

DET_SHAPE = (24, 30)
PIXEL = 2.5


def tilted(matrices: Tensor, degrees: float, lean: float = 0.0) -> Tensor:
    """Matrices of detectors turned in their plane about pixel (0, 0), and leaning so that the magnification drifts."""
    turn = rotation((0, 0, 1), degrees)
    turn[2, :2] = lean
    return turn @ matrices


def lying(matrices: Tensor) -> Tensor:
    """Matrices with rows and columns exchanged."""
    return matrices[:, [1, 0, 2]]


def views(kind: str) -> Tensor:
    """Matrices (V, 3, 4) of upright, flipped, tilted, lying or steep views, some of them of the case just at 45 deg."""
    options = {"det_shape": DET_SHAPE, "pixel": PIXEL}
    shots = ((0, 0.0), (45, 60.0), (77, -90.0), (135, 0.0), (260, 30.0))
    upright = torch.cat([camera(angle, source_z=z, **options) for angle, z in shots])
    if kind == "upright":
        return upright
    if kind == "flipped":  # rows run down
        flip = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
        flip[1, 2] = DET_SHAPE[0] - 1
        return flip @ upright
    if kind == "tilted":
        return tilted(upright, 2.0, 1e-4)
    if kind == "lying":
        return lying(upright)
    if kind == "steep":  # sources above and below the patient, and far from any axis
        over = torch.eye(4, dtype=torch.float64)
        over[:3, :3] = rotation((0.3, 1, 0.2), 80)
        return upright @ over
    raise ValueError(kind)


KINDS = ("upright", "flipped", "tilted", "lying", "steep")


def skew_grid(shape: tuple[int, int, int] = (14, 18, 20)) -> VolumeGrid:
    """A grid off the centre, of three spacings, turned about an axis of its own."""
    return VolumeGrid.centered(
        shape, (1.9, 2.3, 1.6), center=(3.0, -2.0, 1.0), direction=rotation((1, 2, 3), 25).tolist()
    )


def straight_grid(shape: tuple[int, int, int] = (14, 18, 20)) -> VolumeGrid:
    """A grid off the centre, along the world's axes."""
    return VolumeGrid.centered(shape, (1.9, 2.3, 1.6), center=(3.0, -2.0, 1.0))


GRIDS = {"straight": straight_grid, "skew": skew_grid}


def ellipsoid_volume(grid: VolumeGrid, center: Tensor, axes: Tensor, finer: int = 4) -> Tensor:
    """Each voxel's share (D, H, W) that is inside an ellipsoid of half axes (3,); sampled finer times each way."""
    depth, height, width = grid.shape
    fine = VolumeGrid(
        (depth * finer, height * finer, width * finer),
        tuple(d / finer for d in grid.spacing),
        tuple(
            (
                torch.tensor(grid.origin, dtype=torch.float64)
                - torch.tensor(grid.direction, dtype=torch.float64)
                @ torch.tensor(grid.spacing, dtype=torch.float64)
                * (finer - 1)
                / (2 * finer)
            ).tolist()
        ),
        grid.direction,
    )
    inside = (((fine.points(dtype=torch.float64) - center) / axes).square().sum(-1) < 1).double()
    return inside.reshape(depth, finer, height, finer, width, finer).mean((1, 3, 5))


def ellipsoid_chords(matrices: Tensor, det_shape: tuple[int, int], center: Tensor, axes: Tensor) -> Tensor:
    """Length (V, rows, cols) of each pixel's ray inside the ellipsoid."""
    chords = []
    for matrix in matrices:
        source, directions = rays(matrix, det_shape)
        start, along = (source - center) / axes, directions / axes
        a, b, c = along.square().sum(-1), (along * start).sum(-1), start.square().sum() - 1
        chords.append(2 * (b * b - a * c).clamp(min=0).sqrt() / a)
    return torch.stack(chords)

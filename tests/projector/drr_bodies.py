"""Cameras, lattices and path lengths for the tests of the point-cloud DRR, built by hand."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

SAD, SDD = 404.0, 538.0


def camera(
    angle_deg: float = 0.0,
    *,
    det_shape: tuple[int, int] = (64, 64),
    pixel: float = 0.388,
    source_z: float = 0.0,
    first_pixel: tuple[int, int] | None = None,
) -> Tensor:
    """Projection matrix (1, 3, 4): source at angle b, detector opposite, columns along (-sin b, cos b, 0), rows on z.

    The detector is a crop of a large one: about the image of the origin, or from pixel (row, col) of 768 x 768 on.
    """
    b = math.radians(angle_deg)
    cos, sin = math.cos(b), math.sin(b)
    source = torch.tensor([SAD * cos, SAD * sin, source_z], dtype=torch.float64)
    center = torch.tensor([-(SDD - SAD) * cos, -(SDD - SAD) * sin, 0.0], dtype=torch.float64)
    along_u = torch.tensor([-sin, cos, 0.0], dtype=torch.float64)
    along_v = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normal = torch.tensor([-cos, -sin, 0.0], dtype=torch.float64)
    v_center = det_shape[0] / 2 - 0.5 + round(source_z * (SDD - SAD) / SAD / pixel)
    u_center = det_shape[1] / 2 - 0.5
    if first_pixel is not None:
        v_center, u_center = 383.5 - first_pixel[0], 383.5 - first_pixel[1]
    rows = []
    for axis, middle in ((along_u, u_center), (along_v, v_center)):
        rows.append(SDD / pixel * axis + (middle - axis @ (center - source) / pixel) * normal)
    linear = torch.stack([*rows, normal])
    return torch.cat([linear, -(linear @ source)[:, None]], dim=1)[None]


def rotation(axis: tuple[float, float, float], degrees: float) -> Tensor:
    """Rotation matrix (3, 3) about an axis through the origin."""
    x, y, z = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


@functools.lru_cache(maxsize=16)
def lattice(size: tuple[float, float, float], pitch: float = 0.25) -> Tensor:
    """Nodes (N, 3) in Morton order at the centres of the cells that fill a box about the origin."""
    axes = [(torch.arange(round(s / pitch), dtype=torch.float64) + 0.5) * pitch - s / 2 for s in size]
    points = torch.cartesian_prod(*axes)
    index = ((points - points.amin(0)) / pitch).round().long()
    key = sum(((index[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    return points[key.argsort()]


def rays(matrix: Tensor, det_shape: tuple[int, int], shift: tuple[float, float] = (0.0, 0.0)) -> tuple[Tensor, Tensor]:
    """Source (3,) and unit directions (rows, cols, 3) to the pixels, shifted by (dv, du) pixels."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in det_shape), indexing="ij")
    pixels = torch.stack([u + shift[1], v + shift[0], torch.ones_like(u)], dim=-1)
    inverse = torch.linalg.inv(matrix[:, :3])
    return -inverse @ matrix[:, 3], torch.nn.functional.normalize(pixels @ inverse.T, dim=-1)


def box_chords(source: Tensor, directions: Tensor, size: tuple[float, float, float]) -> Tensor:
    """Length of each ray inside a box about the origin, in the box's own axes."""
    half = torch.tensor(size, dtype=torch.float64) / 2
    near, far = (-half - source) / directions, (half - source) / directions
    entry = torch.minimum(near, far).amax(-1)
    leave = torch.maximum(near, far).amin(-1)
    return (leave - entry).clamp(min=0)


def nearby(mask: Tensor, pixels: int) -> Tensor:
    """Mask grown by so many pixels."""
    kernel = 2 * pixels + 1
    return torch.nn.functional.max_pool2d(mask[None].double(), kernel, stride=1, padding=pixels)[0] > 0

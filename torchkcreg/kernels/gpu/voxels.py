"""Voxel projectors in Triton: one program per block of pixels of a view, or per block of voxels.

Joseph's projector gathers. Its adjoint uses atomic additions, so its last bits may differ from run to run. Positions
along rays are computed in double precision, sums in the precision of the data.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_PIXELS = 128  # per program
_VOXELS = 256
_BIAS_Y, _BIAS_Z = tl.constexpr(1.0 - 1e-6), tl.constexpr(1.0 - 2e-6)  # rounding must not decide at 45 degrees


@triton.jit
def _walk(
    volume, images, rays, spacing, views, rows, cols, depth, height, width, planes,
    PIXELS: tl.constexpr, ADJOINT: tl.constexpr,
):  # fmt: skip
    """Walk along each ray's major axis plane by plane, and read, or add to, four voxels per plane."""
    batch, view = tl.program_id(1) // views, tl.program_id(1) % views
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    there = pixel < rows * cols
    u, v = (pixel % cols).to(tl.float64), (pixel // cols).to(tl.float64)
    at = rays + view * 12
    x = tl.load(at) * u + tl.load(at + 1) * v + tl.load(at + 2)
    y = tl.load(at + 4) * u + tl.load(at + 5) * v + tl.load(at + 6)
    z = tl.load(at + 8) * u + tl.load(at + 9) * v + tl.load(at + 10)
    source_x, source_y, source_z = tl.load(at + 3), tl.load(at + 7), tl.load(at + 11)
    size_x, size_y, size_z = tl.load(spacing), tl.load(spacing + 1), tl.load(spacing + 2)
    length = tl.sqrt(x * size_x * x * size_x + y * size_y * y * size_y + z * size_z * z * size_z)
    wide, tall, deep = tl.abs(x), tl.abs(y) * _BIAS_Y, tl.abs(z) * _BIAS_Z
    along_x, along_z = (wide >= tall) & (wide >= deep), (deep > wide) & (deep > tall)
    along_y = (tall > wide) & (tall >= deep)
    # values of the major axis, and of the two other axes in the order x, y, z
    major, first, second = (
        tl.where(along_x, x, tl.where(along_y, y, z)),
        tl.where(along_x, y, x),
        tl.where(along_z, y, z),
    )
    source = tl.where(along_x, source_x, tl.where(along_y, source_y, source_z))
    source_1, source_2 = tl.where(along_x, source_y, source_x), tl.where(along_z, source_y, source_z)
    count = tl.where(along_x, width, tl.where(along_y, height, depth))
    count_1, count_2 = tl.where(along_x, height, width), tl.where(along_z, height, depth)
    stride = tl.where(along_x, 1, tl.where(along_y, width, height * width))
    stride_1, stride_2 = tl.where(along_x, width, 1), tl.where(along_z, width, height * width)
    kind = images.dtype.element_ty
    slope_1, slope_2, step = first / major, second / major, (length / tl.abs(major)).to(kind)
    start_1, start_2 = source_1 - source * slope_1, source_2 - source * slope_2
    voxels = volume + batch.to(tl.int64) * depth * height * width
    image = images + tl.program_id(1).to(tl.int64) * rows * cols + pixel
    total = tl.zeros([PIXELS], dtype=kind)
    spread = tl.load(image, mask=there, other=0.0) * step if ADJOINT else total
    for plane in range(planes):
        ahead = there & (plane < count) & ((plane - source) * major > 0)
        position_1, position_2 = start_1 + plane * slope_1, start_2 + plane * slope_2
        below_1, below_2 = tl.floor(position_1), tl.floor(position_2)
        share_1, share_2 = (position_1 - below_1).to(kind), (position_2 - below_2).to(kind)
        near = ahead & (position_1 > -1) & (position_1 < count_1) & (position_2 > -1) & (position_2 < count_2)
        index_1, index_2 = tl.where(near, below_1, 0.0).to(tl.int32), tl.where(near, below_2, 0.0).to(tl.int32)
        for corner in tl.static_range(4):
            here_1, here_2 = index_1 + corner % 2, index_2 + corner // 2
            inside = near & (here_1 >= 0) & (here_1 < count_1) & (here_2 >= 0) & (here_2 < count_2)
            weight = (share_1 if corner % 2 == 1 else 1.0 - share_1) * (share_2 if corner // 2 == 1 else 1.0 - share_2)
            place = voxels + plane * stride.to(tl.int64) + here_1 * stride_1 + here_2.to(tl.int64) * stride_2
            if ADJOINT:
                tl.atomic_add(place, spread * weight, mask=inside)
            else:
                total += weight * tl.load(place, mask=inside, other=0.0)
    if not ADJOINT:
        tl.store(image, total * step, mask=there)


@triton.jit
def _gather_views(
    images, matrices, volume, views, rows, cols, depth, height, width, VOXELS: tl.constexpr
):  # fmt: skip
    """Sum over views of the bilinearly interpolated image divided by the squared depth."""
    batch, voxel = tl.program_id(1), tl.program_id(0).to(tl.int64) * VOXELS + tl.arange(0, VOXELS)
    there = voxel < depth.to(tl.int64) * height * width
    x, y, z = voxel % width, (voxel // width) % height, voxel // (width * height)
    x, y, z = x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    kind = images.dtype.element_ty
    total = tl.zeros([VOXELS], dtype=kind)
    for view in range(views):
        at = matrices + view * 12
        far = tl.load(at + 8) * x + tl.load(at + 9) * y + tl.load(at + 10) * z + tl.load(at + 11)
        front = there & (far > 0)
        inverse = 1.0 / tl.where(front, far, 1.0)
        u = (tl.load(at) * x + tl.load(at + 1) * y + tl.load(at + 2) * z + tl.load(at + 3)) * inverse
        v = (tl.load(at + 4) * x + tl.load(at + 5) * y + tl.load(at + 6) * z + tl.load(at + 7)) * inverse
        near = front & (u > -1) & (u < cols) & (v > -1) & (v < rows)
        left, top = tl.floor(tl.where(near, u, 0.0)), tl.floor(tl.where(near, v, 0.0))
        share_u, share_v = (tl.where(near, u, 0.0) - left).to(kind), (tl.where(near, v, 0.0) - top).to(kind)
        image = images + (batch * views + view).to(tl.int64) * rows * cols
        value = tl.zeros([VOXELS], dtype=kind)
        for corner in tl.static_range(4):
            col, row = left.to(tl.int32) + corner % 2, top.to(tl.int32) + corner // 2
            inside = near & (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
            weight = (share_u if corner % 2 == 1 else 1.0 - share_u) * (share_v if corner // 2 == 1 else 1.0 - share_v)
            value += weight * tl.load(image + row * cols + col, mask=inside, other=0.0)
        total += value * (inverse * inverse).to(kind)
    tl.store(volume + batch.to(tl.int64) * depth * height * width + voxel, total, mask=there)


def voxel_project(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int) -> Tensor:
    """Path integrals (B, V, rows, cols); see `torchkcreg.projector.voxel_reference`."""
    volume, rays, spacing = volume.contiguous(), rays.double().contiguous(), spacing.double().contiguous()
    images = volume.new_zeros(len(volume), len(rays), rows, cols)
    if images.numel() and volume.numel():
        _walk[triton.cdiv(rows * cols, _PIXELS), len(volume) * len(rays)](
            volume, images, rays, spacing, len(rays), rows, cols, *volume.shape[1:], max(volume.shape[1:]),
            PIXELS=_PIXELS, ADJOINT=False,
        )  # fmt: skip
    return images


def voxel_backproject(
    images: Tensor, rays: Tensor, spacing: Tensor, depth: int, height: int, width: int
) -> Tensor:  # fmt: skip
    """Adjoint of `voxel_project`: images (B, V, rows, cols) to volumes (B, D, H, W)."""
    images, rays, spacing = images.contiguous(), rays.double().contiguous(), spacing.double().contiguous()
    volume = images.new_zeros(len(images), depth, height, width)
    if images.numel() and volume.numel():
        rows, cols = images.shape[2:]
        _walk[triton.cdiv(rows * cols, _PIXELS), len(images) * len(rays)](
            volume, images, rays, spacing, len(rays), rows, cols, depth, height, width, max(depth, height, width),
            PIXELS=_PIXELS, ADJOINT=True,
        )  # fmt: skip
    return volume


def voxel_backproject_weighted(images: Tensor, matrices: Tensor, depth: int, height: int, width: int) -> Tensor:
    """Sum over views of the image divided by the squared depth, (B, D, H, W); see `voxel_weighted_reference`."""
    images, matrices = images.contiguous(), matrices.double().contiguous()
    volume = images.new_zeros(len(images), depth, height, width)
    if images.numel() and volume.numel():
        _gather_views[triton.cdiv(depth * height * width, _VOXELS), len(images)](
            images, matrices, volume, len(matrices), *images.shape[2:], depth, height, width, VOXELS=_VOXELS
        )
    return volume

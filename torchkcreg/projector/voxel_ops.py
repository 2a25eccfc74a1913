"""Voxel projector and back-projectors as operators with derivatives; the C++ kernels are `csrc/cpu/voxel_*.cpp`."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from torchkcreg.kernels import Operator, kernel
from torchkcreg.kernels.differentiable import linear

from .voxel_reference import backproject_by_planes, backproject_by_voxels, project_by_planes, spread_over_images

_Map = Callable[[Tensor], Tensor]


def voxel_project(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int, *, backend: str) -> Tensor:
    """Path integrals (B, V, rows, cols) of a volume (B, D, H, W); rays and spacing as in `voxel_reference`."""
    depth, height, width = volume.shape[-3:]
    project, backproject = _projector(volume, rays, spacing, (rows, cols), (depth, height, width), backend)
    return linear(volume, project, backproject)


def voxel_backproject(
    images: Tensor, rays: Tensor, spacing: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """Adjoint of `voxel_project`: images (B, V, rows, cols) into (B, D, H, W)."""
    rows, cols = images.shape[-2:]
    project, backproject = _projector(images, rays, spacing, (rows, cols), shape, backend)
    return linear(images, backproject, project)


def voxel_backproject_weighted(
    images: Tensor, matrices: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """Sum over views of image / depth^2, (B, D, H, W); see `voxel_reference.backproject_by_voxels`."""
    rows, cols = images.shape[-2:]
    apply = kernel(VOXEL_BACKPROJECT_WEIGHTED, images, backend)
    # This gradient is not used in iterations, so it has no kernel.
    return linear(
        images,
        lambda data: apply(data, matrices, *shape),
        lambda volume: spread_over_images(volume, matrices, rows, cols),
    )


def _projector(
    data: Tensor, rays: Tensor, spacing: Tensor, det_shape: tuple[int, int], shape: tuple[int, int, int], backend: str
) -> tuple[_Map, _Map]:
    """The projector and its adjoint; each is the gradient of the other."""
    project, backproject = (kernel(op, data, backend) for op in (VOXEL_PROJECT, VOXEL_BACKPROJECT))
    return (
        lambda volume: project(volume, rays, spacing, *det_shape),
        lambda images: backproject(images, rays, spacing, *shape),
    )


# volume (B, D, H, W), rays (V, 3, 4) and spacing (3,) in float64 -> (B, V, rows, cols)
VOXEL_PROJECT = Operator(
    "voxel_project(Tensor volume, Tensor rays, Tensor spacing, int rows, int cols) -> Tensor",
    reference=project_by_planes,
    fake=lambda volume, rays, spacing, rows, cols: volume.new_empty(len(volume), len(rays), rows, cols),
)
# adjoint: images (B, V, rows, cols) -> (B, depth, height, width)
VOXEL_BACKPROJECT = Operator(
    "voxel_backproject(Tensor images, Tensor rays, Tensor spacing, int depth, int height, int width) -> Tensor",
    reference=lambda images, rays, spacing, *shape: backproject_by_planes(images, rays, spacing, shape),
    fake=lambda images, rays, spacing, *shape: images.new_empty(len(images), *shape),
)
# images (B, V, rows, cols), matrices (V, 3, 4) in float64 -> (B, depth, height, width)
VOXEL_BACKPROJECT_WEIGHTED = Operator(
    "voxel_backproject_weighted(Tensor images, Tensor matrices, int depth, int height, int width) -> Tensor",
    reference=lambda images, matrices, *shape: backproject_by_voxels(images, matrices, shape),
    fake=lambda images, matrices, *shape: images.new_empty(len(images), *shape),
)

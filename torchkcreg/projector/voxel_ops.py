"""The voxel projector as torch operators: fake kernels, derivatives, and the choice of the backend.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``; see `backends` for when they are loaded.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchkcreg.differentiable import linear

from .backends import choose_backend
from .voxel_reference import backproject_by_planes, project_by_planes
from .voxel_weighted_reference import backproject_by_voxels, spread_over_images

_Map = Callable[[Tensor], Tensor]


def voxel_project(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int, *, backend: str) -> Tensor:
    """Path integrals (B, V, rows, cols) of volume (B, D, H, W); see `voxel_reference` for rays and spacing."""
    depth, height, width = volume.shape[-3:]
    shape = (depth, height, width)
    project, backproject = _projector(rays, spacing, (rows, cols), shape, choose_backend(volume, backend))
    return linear(volume, project, backproject)


def voxel_backproject(
    images: Tensor, rays: Tensor, spacing: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """The adjoint of `voxel_project`: images (B, V, rows, cols) into (B, D, H, W)."""
    rows, cols = images.shape[-2:]
    project, backproject = _projector(rays, spacing, (rows, cols), shape, choose_backend(images, backend))
    return linear(images, backproject, project)


def voxel_backproject_weighted(
    images: Tensor, matrices: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """Sum over views of the image over the squared depth, (B, D, H, W); see `voxel_weighted_reference`."""
    rows, cols = images.shape[-2:]
    compiled = choose_backend(images, backend) == "cpp"

    def apply(data: Tensor) -> Tensor:
        if compiled:
            return torch.ops.torchkcreg.voxel_backproject_weighted(data, matrices, *shape)
        return backproject_by_voxels(data, matrices, shape)

    # Nothing iterates with this gradient, so it has no kernel of its own.
    return linear(images, apply, lambda volume: spread_over_images(volume, matrices, rows, cols))


def _projector(
    rays: Tensor, spacing: Tensor, det_shape: tuple[int, int], shape: tuple[int, int, int], backend: str
) -> tuple[_Map, _Map]:
    """The projector and its adjoint, each other's gradient."""
    if backend == "cpp":
        kernels = torch.ops.torchkcreg
        return (
            lambda volume: kernels.voxel_project(volume, rays, spacing, *det_shape),
            lambda images: kernels.voxel_backproject(images, rays, spacing, *shape),
        )
    return (
        lambda volume: project_by_planes(volume, rays, spacing, *det_shape),
        lambda images: backproject_by_planes(images, rays, spacing, shape),
    )


def register() -> None:
    """Fake kernels of the compiled operators."""
    for name, fake in (
        ("voxel_project", _fake_images),
        ("voxel_backproject", _fake_volume),
        ("voxel_backproject_weighted", _fake_weighted),
    ):
        torch.library.register_fake(f"torchkcreg::{name}", fake)


def _fake_images(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int) -> Tensor:
    return volume.new_empty(volume.shape[0], rays.shape[0], rows, cols)


def _fake_volume(images: Tensor, rays: Tensor, spacing: Tensor, depth: int, height: int, width: int) -> Tensor:
    return images.new_empty(images.shape[0], depth, height, width)


def _fake_weighted(images: Tensor, matrices: Tensor, depth: int, height: int, width: int) -> Tensor:
    return images.new_empty(images.shape[0], depth, height, width)

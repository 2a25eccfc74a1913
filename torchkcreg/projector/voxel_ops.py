"""The voxel projector as torch operators: fake kernels, autograd, and the choice of the backend.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``; see `backends` for when they are loaded.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .backends import choose_backend
from .voxel_reference import backproject_by_planes, project_by_planes
from .voxel_weighted_reference import backproject_by_voxels, spread_over_images


def voxel_project(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int, *, backend: str) -> Tensor:
    """Path integrals (B, V, rows, cols) of volume (B, D, H, W); see `voxel_reference` for rays and spacing."""
    if choose_backend(volume, backend) == "cpp":
        return torch.ops.torchkcreg.voxel_project(volume, rays, spacing, rows, cols)
    return project_by_planes(volume, rays, spacing, rows, cols)


def voxel_backproject(
    images: Tensor, rays: Tensor, spacing: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """The adjoint of `voxel_project`: images (B, V, rows, cols) into (B, D, H, W)."""
    if choose_backend(images, backend) == "cpp":
        return torch.ops.torchkcreg.voxel_backproject(images, rays, spacing, *shape)
    return backproject_by_planes(images, rays, spacing, shape)


def voxel_backproject_weighted(
    images: Tensor, matrices: Tensor, shape: tuple[int, int, int], *, backend: str
) -> Tensor:
    """Sum over views of the image over the squared depth, (B, D, H, W); see `voxel_weighted_reference`."""
    if choose_backend(images, backend) == "cpp":
        return torch.ops.torchkcreg.voxel_backproject_weighted(images, matrices, *shape)
    return backproject_by_voxels(images, matrices, shape)


def register() -> None:
    """Fake kernels and autograd of the compiled operators; the projector and its adjoint are each other's gradient."""
    for name, fake, backward, context in (
        ("voxel_project", _fake_images, _project_backward, _project_context),
        ("voxel_backproject", _fake_volume, _backproject_backward, _backproject_context),
        ("voxel_backproject_weighted", _fake_weighted, _weighted_backward, _weighted_context),
    ):
        torch.library.register_fake(f"torchkcreg::{name}", fake)
        torch.library.register_autograd(f"torchkcreg::{name}", backward, setup_context=context)


def _fake_images(volume: Tensor, rays: Tensor, spacing: Tensor, rows: int, cols: int) -> Tensor:
    return volume.new_empty(volume.shape[0], rays.shape[0], rows, cols)


def _fake_volume(images: Tensor, rays: Tensor, spacing: Tensor, depth: int, height: int, width: int) -> Tensor:
    return images.new_empty(images.shape[0], depth, height, width)


def _fake_weighted(images: Tensor, matrices: Tensor, depth: int, height: int, width: int) -> Tensor:
    return images.new_empty(images.shape[0], depth, height, width)


def _project_context(ctx, inputs: tuple, output: Tensor) -> None:
    volume, rays, spacing, _, _ = inputs
    ctx.shape = volume.shape[1:]
    ctx.save_for_backward(rays, spacing)


def _project_backward(ctx, grad: Tensor) -> tuple:
    return torch.ops.torchkcreg.voxel_backproject(grad, *ctx.saved_tensors, *ctx.shape), None, None, None, None


def _backproject_context(ctx, inputs: tuple, output: Tensor) -> None:
    images, rays, spacing, *_ = inputs
    ctx.det_shape = images.shape[2:]
    ctx.save_for_backward(rays, spacing)


def _backproject_backward(ctx, grad: Tensor) -> tuple:
    images = torch.ops.torchkcreg.voxel_project(grad, *ctx.saved_tensors, *ctx.det_shape)
    return images, None, None, None, None, None


def _weighted_context(ctx, inputs: tuple, output: Tensor) -> None:
    images, matrices, *_ = inputs
    ctx.det_shape = images.shape[2:]
    ctx.save_for_backward(matrices)


def _weighted_backward(ctx, grad: Tensor) -> tuple:
    # Nothing iterates with this gradient, so it has no kernel of its own.
    return spread_over_images(grad, *ctx.saved_tensors, *ctx.det_shape), None, None, None, None

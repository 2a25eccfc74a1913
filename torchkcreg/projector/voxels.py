"""Path integrals through a voxel volume, their exact adjoint, and the weighted back-projection of FDK."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchkcreg.geometry import VolumeGrid
from torchkcreg.precision import full_precision

from .voxel_ops import voxel_backproject, voxel_backproject_weighted, voxel_project

Views = slice | Sequence[int] | Tensor | None


@full_precision
def project_volume(
    volume: Tensor,  # (..., D, H, W)
    grid: VolumeGrid,
    projection_matrices: Tensor,  # (V, 3, 4)
    det_shape: tuple[int, int],
    *,
    backend: str = "auto",
) -> Tensor:  # (..., V, rows, cols)
    """Path integral (value x mm) of a volume along the ray of each pixel centre, by Joseph's method.

    A ray is sampled where it crosses the lattice planes of the axis along which its voxel index changes most, by
    bilinear interpolation in the plane (Joseph, IEEE Trans. Med. Imaging 1(3), 1982), and starts at the source. Beyond
    the outermost voxel centres the volume fades to zero over one voxel, so that every voxel counts in full. Outside the
    grid the volume is zero, and so is the integral of a ray that misses the grid.

    Differentiable in the volume, to any order; the gradient is `backproject`. The matrices are taken as constant.

    Args:
        volume: Voxel values, shape (..., D, H, W), in 1/mm for line integrals of attenuation; leading axes are
            candidates.
        grid: Grid of the volume, with any direction.
        projection_matrices: World mm to homogeneous 0-based pixels, shape (V, 3, 4), with an invertible left part and
            any scale. The grid's centre is taken to be in front of the source.
        det_shape: Detector size (rows, cols).
        backend: "auto" (C++ on a CPU, Triton on a GPU, torch where they are not available), "cpp", "triton" or
            "torch". All give the same numbers up to rounding.

    Returns:
        Images of the volume's dtype, shape (..., V, rows, cols), bitwise the same for any number of threads.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, matrices are not finite, not invertible or require a gradient,
            or the backend does not exist.
        OSError: With `backend="cpp"`, if the C++ kernels are not available.

    >>> P = torch.tensor([[[1000.0, 0, 32, 16000], [0, 1000, 32, 16000], [0, 0, 1, 500]]])  # 1000 px of focal length
    >>> grid = VolumeGrid.centered((10, 20, 20), 0.5)
    >>> images = project_volume(torch.full(grid.shape, 0.02), grid, P, (65, 65))  # through 5 mm of water or so
    >>> round(float(images[0, 32, 32]), 4)
    0.1
    """
    rays, spacing = _rays(grid, projection_matrices, volume)
    _check_batch("volume", volume, grid.shape)
    rows, cols = _checked_det_shape(det_shape)
    flat = _flat(volume)
    return voxel_project(flat, rays, spacing, rows, cols, backend=backend).reshape(
        *volume.shape[:-3], len(rays), rows, cols
    )


@full_precision
def backproject(
    projections: Tensor,  # (..., V, rows, cols)
    grid: VolumeGrid,
    projection_matrices: Tensor,  # (V, 3, 4)
    *,
    backend: str = "auto",
) -> Tensor:  # (..., D, H, W)
    """Adjoint of `project_volume`: for each voxel the sum over pixels with the weights of the projector.

    `<project_volume(x), y> = <x, backproject(y)>` up to rounding. Differentiable in the projections; the gradient is
    `project_volume`. To use a subset of views, slice both arguments (`projections[..., 3::10, :, :]`,
    `matrices[3::10]`); this copies no images.

    Args:
        projections: Images, shape (..., V, rows, cols).
        grid: Grid of the result.
        projection_matrices: As for `project_volume`, shape (V, 3, 4).
        backend: "auto", "cpp", "triton" or "torch".

    Returns:
        Volume of the projections' dtype, shape (..., D, H, W), zero where no ray passes; bitwise the same for any
        number of threads.

    Raises:
        ValueError: As for `project_volume`.
        OSError: As for `project_volume`.

    >>> P = torch.tensor([[[1000.0, 0, 32, 16000], [0, 1000, 32, 16000], [0, 0, 1, 500]]])
    >>> grid = VolumeGrid.centered((10, 20, 20), 0.5)
    >>> backproject(torch.ones(1, 65, 65), grid, P).shape
    torch.Size([10, 20, 20])
    """
    rays, spacing = _rays(grid, projection_matrices, projections)
    flat = _flat_images(projections, len(rays))
    volume = voxel_backproject(flat, rays, spacing, grid.shape, backend=backend)
    return volume.reshape(*projections.shape[:-3], *grid.shape)


@full_precision
def backproject_weighted(
    projections: Tensor,  # (..., V, rows, cols)
    grid: VolumeGrid,
    projection_matrices: Tensor,  # (V, 3, 4)
    *,
    backend: str = "auto",
) -> Tensor:  # (..., D, H, W)
    """Voxel-driven back-projection with FDK's weight: `sum over views of image(u, v) / depth^2`, depth in mm.

    The image is interpolated bilinearly at the projection of the voxel's centre, and fades to zero over one pixel
    beyond the outermost pixel centres. Voxels behind the source get zero. This is not the adjoint of `project_volume`
    but the back-projection of inversion formulas (Feldkamp, Davis, Kress, J. Opt. Soc. Am. A 1(6), 1984).

    Differentiable in the projections.

    Args:
        projections: Filtered images, shape (..., V, rows, cols).
        grid: Grid of the result.
        projection_matrices: As for `project_volume`, shape (V, 3, 4).
        backend: "auto", "cpp", "triton" or "torch".

    Returns:
        Volume of the projections' dtype, shape (..., D, H, W), bitwise the same for any number of threads.

    Raises:
        ValueError: As for `project_volume`.
        OSError: As for `project_volume`.

    >>> P = torch.tensor([[[1000.0, 0, 32, 16000], [0, 1000, 32, 16000], [0, 0, 1, 500]]])
    >>> volume = backproject_weighted(torch.ones(1, 65, 65), VolumeGrid((1, 1, 1)), P)
    >>> round(float(volume * 500**2), 4)
    1.0
    """
    matrices = _checked_matrices(grid, projection_matrices, projections)
    flat = _flat_images(projections, len(matrices))
    matrices = matrices @ grid.voxel_to_world.to(matrices.device)
    volume = voxel_backproject_weighted(flat, matrices, grid.shape, backend=backend)
    return volume.reshape(*projections.shape[:-3], *grid.shape)


class VolumeProjector(nn.Module):
    """Path integrals of volumes in the views of a geometry, and the adjoint; `project_volume` as a module.

    Args:
        geometry: Object with `projection_matrices` (V, 3, 4) and `det_shape` (rows, cols), such as a
            `ConeBeamGeometry`. If it is a module it becomes a submodule.
        grid: Grid of the volumes.
        backend: "auto", "cpp", "triton" or "torch".

    >>> from torchkcreg.geometry import circular_geometry
    >>> geometry = circular_geometry(range(0, 360, 6), sad=404, sdd=538, det_shape=(48, 64), pixel_spacing=(2.0, 2.0))
    >>> projector = VolumeProjector(geometry, VolumeGrid.centered((8, 16, 16), 2.0))
    >>> images = projector(torch.ones(8, 16, 16), views=slice(0, None, 10))
    >>> images.shape, projector.adjoint(images, views=slice(0, None, 10)).shape
    (torch.Size([6, 48, 64]), torch.Size([8, 16, 16]))
    """

    def __init__(self, geometry, grid: VolumeGrid, *, backend: str = "auto") -> None:
        super().__init__()
        self.geometry = geometry
        self.grid = grid
        self.backend = backend

    def forward(self, volume: Tensor, *, views: Views = None) -> Tensor:
        """Images (..., n, rows, cols) of a volume (..., D, H, W) in the n selected views, by default all."""
        return project_volume(volume, self.grid, self._matrices(views), self.geometry.det_shape, backend=self.backend)

    def adjoint(self, projections: Tensor, *, views: Views = None) -> Tensor:
        """Volume (..., D, H, W) from images (..., n, rows, cols) of the n selected views; see `backproject`."""
        matrices = self._matrices(views)
        if tuple(projections.shape[-2:]) != tuple(self.geometry.det_shape):
            rows, cols = self.geometry.det_shape
            raise ValueError(f"projections must have shape (..., V, {rows}, {cols}), got {tuple(projections.shape)}")
        return backproject(projections, self.grid, matrices, backend=self.backend)

    def _matrices(self, views: Views) -> Tensor:
        matrices = self.geometry.projection_matrices
        if views is None:
            return matrices
        if isinstance(views, slice):
            return matrices[views]
        chosen = torch.as_tensor(views, device=matrices.device)
        if chosen.dim() != 1 or chosen.dtype == torch.bool or chosen.is_floating_point():
            raise ValueError(f"views must be a slice or a list of view indices, got {views}")
        if bool(((chosen < -len(matrices)) | (chosen >= len(matrices))).any()):
            raise ValueError(f"views must name some of the {len(matrices)} views, got {chosen.tolist()}")
        return matrices[chosen]

    def extra_repr(self) -> str:
        """Grid and backend for `repr`."""
        return f"grid={self.grid}, backend={self.backend!r}"


def _rays(grid: VolumeGrid, matrices: Tensor, data: Tensor) -> tuple[Tensor, Tensor]:
    """`[D | s]` of each view in voxel indices, (V, 3, 4), and the voxel spacing (3,), both in float64.

    If `Q = [M | q]` maps voxel indices to pixels, `D = M^-1` and `s = -M^-1 q`.
    """
    checked = _checked_matrices(grid, matrices, data)
    to_pixels = checked @ grid.voxel_to_world.to(checked.device)
    inverse = torch.linalg.inv(to_pixels[:, :, :3])
    rays = torch.cat([inverse, -inverse @ to_pixels[:, :, 3:]], dim=-1)
    return rays, torch.tensor(grid.spacing, dtype=torch.float64, device=data.device)


def _checked_matrices(grid: VolumeGrid, matrices: Tensor, data: Tensor) -> Tensor:
    """Matrices in float64 whose row 2 is the depth in mm, positive at the grid's centre."""
    if data.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"volume and projections must be float32 or float64, got {data.dtype}")
    if matrices.dim() != 3 or tuple(matrices.shape[1:]) != (3, 4):
        raise ValueError(f"projection_matrices must have shape (V, 3, 4), got {tuple(matrices.shape)}")
    if matrices.device != data.device:
        raise ValueError(f"projection_matrices must be on the data's device {data.device}, got {matrices.device}")
    if matrices.requires_grad:
        raise ValueError("projection_matrices must not require a gradient: they count as constant, detach them")
    matrices = matrices.double().contiguous()  # another memory layout may round differently
    if not bool(matrices.isfinite().all()):
        raise ValueError("projection_matrices must be finite")
    normals = matrices[:, :, :3].norm(dim=-1, keepdim=True)
    if bool((torch.linalg.det(matrices[:, :, :3] / normals.clamp_min(1e-300)).abs() < 1e-9).any()):
        raise ValueError("projection_matrices must have an invertible left 3 x 3 part")
    matrices = matrices / normals[:, 2:]
    to_world = grid.voxel_to_world
    center = to_world[:3] @ to_world.new_tensor([*((n - 1) / 2 for n in grid.shape[::-1]), 1.0])
    depth = matrices[:, 2, :3] @ center.to(matrices.device) + matrices[:, 2, 3]
    return torch.where(depth < 0, -1.0, 1.0)[:, None, None] * matrices


def _flat(data: Tensor) -> Tensor:
    """The data with all axes before the last three flattened to one."""
    return data.reshape(math.prod(data.shape[:-3]), *data.shape[-3:])  # -1 fails for tensors without elements


def _flat_images(projections: Tensor, num_views: int) -> Tensor:
    if projections.dim() < 3 or projections.shape[-3] != num_views or 0 in projections.shape[-2:]:
        shape = tuple(projections.shape)
        raise ValueError(f"projections must have shape (..., V, rows, cols) with V = {num_views} matrices, got {shape}")
    return _flat(projections)


def _check_batch(name: str, data: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(data.shape[-len(shape) :]) != tuple(shape):
        raise ValueError(f"{name} must have shape (..., {', '.join(map(str, shape))}), got {tuple(data.shape)}")


def _checked_det_shape(det_shape: Sequence[int]) -> tuple[int, int]:
    if len(det_shape) != 2 or any(int(n) != n or n < 1 for n in det_shape):
        raise ValueError(f"det_shape must be (rows, cols), both positive, got {tuple(det_shape)}")
    return int(det_shape[0]), int(det_shape[1])

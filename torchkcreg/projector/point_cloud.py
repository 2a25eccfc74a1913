"""DRRs of a point cloud: path length in mm through nodes that each represent a small cell of metal."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchkcreg.kernels import choose_backend
from torchkcreg.precision import full_precision

from .footprint import Footprint, cell_footprint
from .point_ops import POINT_DRR, point_drr


@full_precision
def project_points(
    points: Tensor,  # (..., N, 3)
    volumes: Tensor,  # (N,)
    projection_matrices: Tensor,  # (V, 3, 4)
    det_shape: tuple[int, int],
    *,
    cell: Tensor | None = None,  # (3, 3) or (num_blocks, 3, 3)
    footprint: Footprint | None = None,
    backend: str = "auto",
) -> Tensor:  # (..., V, rows, cols)
    """Path length in mm through a point cloud, averaged over each pixel, for each view and candidate.

    A node of volume `V_n` at depth d adds its footprint, which sums to one over the pixels, with the amplitude
    `V_n |det M| |M^-1 (u, v, 1)| / d^2` where `P = [M | m]`. This is `V_n` times the squared ratio of the
    distances source-pixel and source-node, divided by pixel area times cosine of the obliquity. The DRR of a lattice
    that fills a body is therefore the body's path length. Nodes behind the source or with NaN coordinates are skipped.
    Parts of footprints outside the detector are dropped.

    Differentiable in points, volumes and projection matrices, in forward and reverse mode and to any order. The shape
    of the footprint is taken as constant. It is piecewise bilinear, so second derivatives are those between its kinks.
    Under `torch.autocast` it computes in float32. The images have the dtype of the points, also if the
    matrices have another.

    Args:
        points: Nodes in world mm, shape (..., N, 3); leading axes are candidates. Neighbours in memory should be
            neighbours in space (Morton order), which makes footprints accurate and the projection fast.
        volumes: Volume of each node in mm^3, shape (N,).
        projection_matrices: World mm to homogeneous 0-based pixels, shape (V, 3, 4); row 2 gives the depth in mm.
        det_shape: Detector size (rows, cols).
        cell: Edge vectors (rows) of a node's cell in world mm; one matrix, or one for each block of 8192 nodes. Give
            either `cell` or `footprint`.
        footprint: Precomputed footprint. It can be reused for poses up to about 5 degrees away: path lengths stay right
            and stripes stay below 0.2 %.
        backend: "auto" (C++ on a CPU, Triton on a GPU, torch where they are not available), "cpp", "triton" or
            "torch". All give the same numbers up to rounding.

    Returns:
        Path lengths in mm, shape (..., V, rows, cols), bitwise the same for any number of threads.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, the backend does not exist, or (checked with `cell`) all nodes
            lie behind the source of a view, as with a matrix of the wrong sign.
        OSError: With `backend="cpp"`, if the C++ kernels are not available.

    >>> P = torch.tensor([[[1000.0, 0, 32, 16000], [0, 1000, 32, 16000], [0, 0, 1, 500]]])  # 1000 px of focal length
    >>> line = torch.arange(-4.875, 5, 0.25)
    >>> points = torch.cartesian_prod(line, line, torch.tensor([-0.125, 0.125]))  # a slab 0.5 mm thick
    >>> drr = project_points(points, torch.full((len(points),), 0.25**3), P, (65, 65), cell=0.25 * torch.eye(3))
    >>> round(float(drr[0, 32, 32]), 3)
    0.5
    """
    _check_points(points, volumes, projection_matrices, det_shape)
    choose_backend(points, backend, operator=POINT_DRR.name)  # rejects a wrong name before the footprint is computed
    if footprint is None and cell is not None:
        _check_front(points, projection_matrices)
        footprint = cell_footprint(points, cell, projection_matrices)
    elif footprint is None or cell is not None:
        raise ValueError("give either cell or footprint")
    _check_footprint(footprint, points, projection_matrices)

    rows, cols = det_shape
    images = point_drr(
        points.reshape(-1, *points.shape[-2:]),
        volumes.to(points.dtype),
        projection_matrices.to(points.dtype),
        footprint.table.detach().to(points.dtype),
        footprint.block_size,
        rows,
        cols,
        backend=backend,
    )
    factors = pixel_factors(projection_matrices, det_shape, dtype=points.dtype)
    images = images * factors if factors.requires_grad else images.mul_(factors)  # in place: avoids copying all images
    return images.reshape(*points.shape[:-2], *images.shape[1:])


def pixel_factors(projection_matrices: Tensor, det_shape: tuple[int, int], *, dtype: torch.dtype) -> Tensor:
    """`|det M| |M^-1 (u, v, 1)|` of each pixel, shape (V, rows, cols), where `P = [M | m]`.

    `|M^-1 (u, v, 1)|` is the ratio of ray length to depth, 1 / cosine of the obliquity. Its square is evaluated as a
    quadratic polynomial in u and v.
    """
    rows, cols = det_shape
    device = projection_matrices.device
    linear = projection_matrices[:, :, :3].to(torch.float64)
    gram = torch.linalg.inv(linear @ linear.mT) * torch.linalg.det(linear).square()[:, None, None]
    gram = gram.to(dtype)[..., None, None]  # from here on values are large, without significant cancellation
    u = torch.arange(cols, dtype=dtype, device=device)
    v = torch.arange(rows, dtype=dtype, device=device)[:, None]
    along_u = (gram[:, 0, 0] * u + 2 * gram[:, 0, 2]) * u + gram[:, 2, 2]
    along_v = (gram[:, 1, 1] * v + 2 * gram[:, 1, 2]) * v
    return torch.addcmul(along_u + along_v, 2 * gram[:, 0, 1] * v, u).sqrt()


def _check_points(points: Tensor, volumes: Tensor, matrices: Tensor, det_shape: tuple[int, int]) -> None:
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[-2] == 0:
        raise ValueError(f"points must have shape (..., N, 3) with N > 0, got {tuple(points.shape)}")
    if points.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"points must be float32 or float64, got {points.dtype}")
    if volumes.shape != points.shape[-2:-1]:
        raise ValueError(f"volumes must have shape ({points.shape[-2]},), got {tuple(volumes.shape)}")
    if matrices.dim() != 3 or matrices.shape[1:] != (3, 4):
        raise ValueError(f"projection_matrices must have shape (V, 3, 4), got {tuple(matrices.shape)}")
    for name, tensor in (("volumes", volumes), ("projection_matrices", matrices)):
        if not tensor.is_floating_point():
            raise ValueError(f"{name} must be floating point, got {tensor.dtype}")
        if tensor.device != points.device:
            raise ValueError(f"{name} must be on the points' device {points.device}, got {tensor.device}")
    if len(det_shape) != 2 or min(det_shape) < 1:
        raise ValueError(f"det_shape must be (rows, cols), both positive, got {tuple(det_shape)}")


def _check_front(points: Tensor, matrices: Tensor) -> None:
    """Raise ValueError if all nodes lie behind the source of a view."""
    front = matrices[:, 2].to(points.dtype).detach()
    behind = (points.detach() @ front[:, :3].mT + front[:, 3] <= 0).flatten(0, -2).all(0)
    if bool(behind.any()):
        raise ValueError(
            f"all points lie behind the source of view {int(behind.nonzero()[0])}: its projection matrix may have the "
            "wrong sign (a ConeBeamGeometry sets it)"
        )


def _check_footprint(footprint: Footprint, points: Tensor, matrices: Tensor) -> None:
    table = footprint.table
    num_blocks = -(-points.shape[-2] // footprint.block_size)
    if table.dim() != 6 or table.shape[:2] != (len(matrices), num_blocks):
        raise ValueError(
            f"footprint must have {len(matrices)} views and {num_blocks} blocks, got a table of {tuple(table.shape)}"
        )
    if table.device != points.device:
        raise ValueError(f"footprint must be on the points' device {points.device}, got {table.device}")


class PointCloudProjector(nn.Module):
    """DRRs of a point cloud in the views of a geometry; `project_points` as a module.

    Args:
        geometry: Object with `projection_matrices` (V, 3, 4) and `det_shape` (rows, cols), such as a
            `ConeBeamGeometry`. If it is a module it becomes a submodule.
        backend: As in `project_points`: "auto", "cpp", "triton" or "torch".
    """

    def __init__(self, geometry, *, backend: str = "auto") -> None:
        super().__init__()
        self.geometry = geometry
        self.backend = backend

    def forward(
        self, points: Tensor, volumes: Tensor, *, cell: Tensor | None = None, footprint: Footprint | None = None
    ) -> Tensor:
        """Path lengths (..., V, rows, cols) in mm of points (..., N, 3); see `project_points`."""
        geometry = self.geometry
        return project_points(
            points,
            volumes,
            geometry.projection_matrices,
            geometry.det_shape,
            cell=cell,
            footprint=footprint,
            backend=self.backend,
        )

    def extra_repr(self) -> str:
        """Backend for `repr`."""
        return f"backend={self.backend!r}"

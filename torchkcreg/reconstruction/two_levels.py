"""Projector and roughness of images on two levels of voxels: small ones near the metal, large ones elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from torchkcreg.geometry import ConeBeamGeometry, TwoLevelGrid
from torchkcreg.geometry.two_level_grid import means, repeated

from .system import VoxelSystem, pair_curvature, pair_gradient, pair_roughness


class TwoLevelSystem(nn.Module):
    """Voxel projector of a `TwoLevelGrid`'s images (N,), as a `System`.

    All coarse voxels are projected as usual; divided ones have the mean of their fine voxels. The difference between
    the fine voxels and the interpolated coarse ones is projected on pixels finer than the detector's. Constant images
    therefore show no step where the levels meet.

    Args:
        geometry: The views.
        grid: The voxels.
        oversampling: Rays along each side of a pixel, for the fine voxels.
        backend: "auto", "cpp", "triton" or "torch".
    """

    def __init__(
        self, geometry: ConeBeamGeometry, grid: TwoLevelGrid, *, oversampling: int = 2, backend: str = "auto"
    ) -> None:
        super().__init__()
        self.grid, self.oversampling = grid, oversampling
        rays = geometry.refined(oversampling) if oversampling > 1 else geometry
        self.coarse = VoxelSystem(geometry, grid.coarse, backend=backend)
        self.fine = VoxelSystem(rays, grid.fine, backend=backend)

    @property
    def volume_shape(self) -> tuple[int, ...]:
        """(N,)."""
        return self.grid.shape

    @property
    def num_views(self) -> int:
        """V."""
        return self.coarse.num_views

    @property
    def sources(self) -> tuple[str, ...] | None:
        """Labels of the views' focal spots."""
        return self.coarse.sources

    def project(self, volume: Tensor, views: Sequence[int]) -> Tensor:
        """Line integrals (len(views), rows, cols) of an image (N,)."""
        coarse, fine = self.grid.split(volume)
        filled = self.grid.with_means(coarse, fine)
        detail = (fine - self.grid.interpolated(filled)).mul_(self.grid.within)
        images = self.fine.project(detail, views)
        return self.coarse.project(filled, views) + avg_pool2d(images[:, None], self.oversampling)[:, 0]

    def backproject(self, images: Tensor, views: Sequence[int]) -> Tensor:
        """Adjoint projection: an image (N,) from images (len(views), rows, cols)."""
        grid, n = self.grid, self.oversampling
        shares = (images / n**2).repeat_interleave(n, 1).repeat_interleave(n, 2)
        fine = self.fine.backproject(shares, views).mul_(grid.within)
        filled = self.coarse.backproject(images, views)
        filled[grid.box] -= grid.interpolated_adjoint(fine)
        fine[:] += repeated(filled[grid.box] * grid.divided[grid.box], grid.factor) / grid.factor**3
        return grid.join(filled, fine)

    def extra_repr(self) -> str:
        """Grid and rays."""
        return f"grid={self.grid}, oversampling={self.oversampling}"


class TwoLevelRoughness:
    """`1/2 integral |grad x|^2` of a `TwoLevelGrid`'s images, divided by the coarse voxel's edge; a `Roughness`.

    Each face between two voxels contributes `area / distance * (x_i - x_j)^2 / 2`, with the centre-to-centre distance
    measured perpendicular to the face. Without divided voxels this is `quadratic_roughness`. Structures are smoothed
    equally on both levels.
    """

    def __init__(self, grid: TwoLevelGrid) -> None:
        self.grid = grid
        edge = grid.coarse.voxel_volume ** (1 / 3)
        coarse, fine = ~grid.divided, grid.within
        self.coarse_weights, self.fine_weights = [], []
        n = grid.factor
        for dim, step in zip((-3, -2, -1), reversed(grid.spacing), strict=True):
            large = grid.coarse.voxel_volume / step**2 / edge
            first, second = _pairs(coarse, dim)
            self.coarse_weights.append((dim, large * (first & second)))
            first, second = _pairs(fine, dim)
            inner, mixed = large / n, large * 2 / (n + n**2)  # area / distance: 1/n^2 over 1/n, and over (1 + 1/n) / 2
            self.fine_weights.append((dim, inner * (first & second) + mixed * (first ^ second)))

    def _levels(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Coarse values, and fine values with undivided coarse values repeated."""
        coarse, fine = self.grid.split(image)
        return coarse, torch.where(self.grid.within, fine, repeated(coarse[self.grid.box], self.grid.factor))

    def value(self, image: Tensor) -> Tensor:
        """The roughness, a scalar."""
        coarse, fine = self._levels(image)
        return pair_roughness(coarse, self.coarse_weights) + pair_roughness(fine, self.fine_weights)

    def gradient(self, image: Tensor) -> Tensor:
        """Derivative of the roughness, (N,)."""
        coarse, fine = self._levels(image)
        return self._joined(pair_gradient(coarse, self.coarse_weights), pair_gradient(fine, self.fine_weights))

    def curvature(self, image: Tensor) -> Tensor:
        """Curvatures (N,) of separable parabolas that majorise it."""
        coarse, fine = self._levels(image)
        return self._joined(pair_curvature(coarse, self.coarse_weights), pair_curvature(fine, self.fine_weights))

    def _joined(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Image (N,) of both levels; the terms of repeated coarse values are added to their coarse voxels."""
        grid = self.grid
        coarse[grid.box] += means(fine * ~grid.within, grid.factor) * grid.factor**3
        return grid.join(coarse, fine)


def _pairs(chosen: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    size = chosen.shape[dim]
    return chosen.narrow(dim, 0, size - 1), chosen.narrow(dim, 1, size - 1)

"""`TwoLevelGrid`: a voxel grid with finer voxels in selected places, such as around metal."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate

from .volume_grid import VolumeGrid, distance_to


class TwoLevelGrid:
    """A voxel grid with some voxels divided into smaller ones.

    An image on this grid is one vector (N,): the flattened coarse volume, then the flattened fine volume of a box
    around the divided voxels. Coarse voxels that are divided and fine voxels outside divided ones are unused: `active`
    is 0 there.

    Args:
        coarse: Grid of the coarse voxels.
        divided: True for the voxels (D, H, W) to divide; the outermost voxels of the grid are never divided.
        factor: Number of fine voxels along each edge.

    Attributes:
        coarse: Grid of the coarse voxels.
        fine: Grid of the fine voxels of the box.
        divided: True for the coarse voxels that are divided, (D, H, W).
        within: True for the fine voxels inside divided ones, (d, h, w).
        factor: Number of fine voxels along the edge of a coarse one.
        box: The box's range of coarse voxels, slices along z, y and x.

    Raises:
        ValueError: The shape is not the grid's, the factor is below 2, or no voxel is to be divided.

    >>> divided = torch.zeros(4, 4, 4, dtype=torch.bool)
    >>> divided[1, 1, 1] = True
    >>> grid = TwoLevelGrid(VolumeGrid.centered((4, 4, 4), 0.75), divided, 3)
    >>> grid.fine.spacing, grid.fine.shape, int(grid.active.sum())
    ((0.25, 0.25, 0.25), (9, 9, 9), 90)
    """

    def __init__(self, coarse: VolumeGrid, divided: Tensor, factor: int) -> None:
        if tuple(divided.shape) != coarse.shape:
            raise ValueError(f"divided must have the grid's shape {coarse.shape}, got {tuple(divided.shape)}")
        if int(factor) != factor or factor < 2:
            raise ValueError(f"factor must be a whole number of at least 2, got {factor}")
        inner = torch.zeros_like(divided, dtype=torch.bool)
        inner[1:-1, 1:-1, 1:-1] = divided[1:-1, 1:-1, 1:-1] > 0
        if not bool(inner.any()):
            raise ValueError("no voxel inside the grid's outermost layer is divided")
        self.coarse, self.divided, self.factor = coarse, inner, int(factor)
        occupied = [
            inner.any(dim=tuple(d for d in range(3) if d != dim)).nonzero().flatten().tolist() for dim in range(3)
        ]
        self.box = tuple(slice(indices[0] - 1, indices[-1] + 2) for indices in occupied)
        self.fine = self._fine()
        self.within = repeated(inner[self.box], self.factor)

    @classmethod
    def near(cls, filled: Tensor, coarse: VolumeGrid, *, within_mm: float, factor: int = 3) -> TwoLevelGrid:
        """Grid with the voxels within a distance of filled ones divided.

        Args:
            filled: Above zero inside the object, such as the metal fraction of each voxel, (D, H, W).
            coarse: Grid of the coarse voxels.
            within_mm: Largest distance from the centre of the nearest filled voxel, mm.
            factor: Number of fine voxels along the edge of a coarse one.

        Raises:
            ValueError: No voxel is filled, or the distance is not positive.
        """
        if not within_mm > 0:
            raise ValueError(f"within_mm must be positive, got {within_mm}")
        if tuple(filled.shape) != coarse.shape or not bool((filled > 0).any()):
            raise ValueError("no voxel of the grid is filled: there is nothing to divide voxels around")
        return cls(coarse, distance_to(filled, coarse) <= within_mm, factor)

    def _fine(self) -> VolumeGrid:
        n, grid = self.factor, self.coarse
        first = [part.start - 0.5 + 0.5 / n for part in reversed(self.box)]
        origin = (grid.voxel_to_world @ torch.tensor([*first, 1.0], dtype=torch.float64))[:3]
        shape = tuple((part.stop - part.start) * n for part in self.box)
        spacing = tuple(step / n for step in grid.spacing)
        return VolumeGrid(shape, spacing, tuple(origin.tolist()), grid.direction)  # type: ignore[arg-type]

    @property
    def shape(self) -> tuple[int]:
        """Shape (N,) of an image."""
        return (self.coarse.num_voxels + self.fine.num_voxels,)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Spacing (x, y, z) of the coarse voxels in mm."""
        return self.coarse.spacing

    @property
    def active(self) -> Tensor:
        """1 for the entries (N,) of an image that are used, 0 for the others."""
        return self.join((~self.divided).float(), self.within.float())

    def split(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The coarse (D, H, W) and fine values (d, h, w) of an image (N,), as tensor views."""
        if tuple(image.shape) != self.shape:
            raise ValueError(f"image must have shape {self.shape}, got {tuple(image.shape)}")
        coarse, fine = image.split([self.coarse.num_voxels, self.fine.num_voxels])
        return coarse.view(self.coarse.shape), fine.view(self.fine.shape)

    def join(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """The image (N,) of coarse values (D, H, W) and fine ones (d, h, w); unused entries are set to 0."""
        return torch.cat([(coarse * ~self.divided).flatten(), (fine * self.within).flatten()])

    def divide(self, volume: Tensor) -> Tensor:
        """The image (N,) of a coarse volume (D, H, W), interpolated where voxels are divided."""
        return self.join(volume, self.interpolated(volume))

    def volumes(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """An image (N,) as two complete volumes, (D, H, W) and (d, h, w), for display.

        Divided voxels get the mean of their fine voxels. Fine voxels outside divided ones are interpolated.
        """
        coarse, fine = self.split(image)
        filled = self.with_means(coarse, fine)
        return filled, torch.where(self.within, fine, self.interpolated(filled))

    def with_means(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Coarse values (D, H, W) with the means of the fine voxels where voxels are divided."""
        filled = coarse.clone()
        filled[self.box] = torch.where(self.divided[self.box], means(fine, self.factor), coarse[self.box])
        return filled

    def interpolated(self, coarse: Tensor) -> Tensor:
        """Coarse values (D, H, W) interpolated linearly at the fine voxels of the box, (d, h, w)."""
        return interpolate(coarse[self.box][None, None], scale_factor=self.factor, mode="trilinear")[0, 0]

    def interpolated_adjoint(self, fine: Tensor) -> Tensor:
        """Adjoint of `interpolated`: fine values (d, h, w) to the coarse voxels of the box only."""
        for dim in (2, 1, 0):
            fine = _shared(fine, self.factor, dim)
        return fine

    def __repr__(self) -> str:
        return f"TwoLevelGrid({self.coarse}, {int(self.divided.sum())} divided, factor={self.factor})"


def means(fine: Tensor, factor: int) -> Tensor:
    """Means (d, h, w) of blocks of factor^3 fine values."""
    return avg_pool3d(fine[None, None], factor)[0, 0]


def repeated(coarse: Tensor, factor: int) -> Tensor:
    """Fine values with each coarse value (d, h, w) repeated in a block of factor^3."""
    wide = coarse[:, None, :, None, :, None].expand(-1, factor, -1, factor, -1, factor)
    return wide.reshape([count * factor for count in coarse.shape])


def _shared(fine: Tensor, factor: int, dim: int) -> Tensor:
    """Adjoint of linear interpolation along a dimension, where each coarse voxel has `factor` fine ones."""
    offsets = (torch.arange(factor, dtype=fine.dtype, device=fine.device) - (factor - 1) / 2) / factor
    weights = torch.stack([1 - offsets.abs(), (-offsets).clamp_min(0), offsets.clamp_min(0)], dim=-1)
    mid, before, after = torch.tensordot(fine.unflatten(dim, (-1, factor)), weights, dims=([dim + 1], [0])).unbind(-1)
    mid, last = mid.clone(), mid.shape[dim] - 1
    mid.narrow(dim, 0, last).add_(before.narrow(dim, 1, last))
    mid.narrow(dim, 1, last).add_(after.narrow(dim, 0, last))
    mid.narrow(dim, 0, 1).add_(before.narrow(dim, 0, 1))  # interpolation repeats the end values beyond the ends
    mid.narrow(dim, last, 1).add_(after.narrow(dim, last, 1))
    return mid

"""`TwoLevelGrid`: voxels of one size, and smaller ones in their place where it matters."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate

from .volume_grid import VolumeGrid, distance_to


class TwoLevelGrid:
    """A grid some of whose voxels are divided into smaller ones.

    An image on it is one vector (N,): the values of all coarse voxels, then those of all fine voxels of a box around
    the divided ones, each volume in its own order. Coarse voxels that are divided, and fine ones that are no part of a
    divided one, hold nothing: `active` is 0 there.

    Args:
        coarse: the grid.
        divided: true for the voxels (D, H, W) that are divided; the outermost voxels of the grid never are.
        factor: into how many along each edge.

    Attributes:
        coarse: the grid.
        fine: the grid of the box, with smaller voxels.
        divided: which coarse voxels are divided, (D, H, W).
        within: which voxels of the box are part of one, (d, h, w).
        factor: fine voxels along the edge of a coarse one.
        box: the coarse voxels that the box consists of, three slices along z, y and x.

    Raises:
        ValueError: a shape that is not the grid's, a factor below 2, or nothing to divide.

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
            raise ValueError("no voxel within the grid's outermost layer is divided")
        self.coarse, self.divided, self.factor = coarse, inner, int(factor)
        places = [
            inner.any(dim=tuple(d for d in range(3) if d != dim)).nonzero().flatten().tolist() for dim in range(3)
        ]
        self.box = tuple(slice(found[0] - 1, found[-1] + 2) for found in places)
        self.fine = self._fine()
        self.within = repeated(inner[self.box], self.factor)

    @classmethod
    def near(cls, filled: Tensor, coarse: VolumeGrid, *, within_mm: float, factor: int = 3) -> TwoLevelGrid:
        """Divides the voxels within so many mm of those that are filled.

        Args:
            filled: above zero where the thing is, such as metal's share of each voxel, (D, H, W).
            coarse: the grid.
            within_mm: of the nearest filled voxel's centre.
            factor: fine voxels along the edge of a coarse one.

        Raises:
            ValueError: nothing is filled, or a length that is not positive.
        """
        if not within_mm > 0:
            raise ValueError(f"within_mm must be positive, got {within_mm}")
        if tuple(filled.shape) != coarse.shape or not bool((filled > 0).any()):
            raise ValueError("nothing within the grid is filled: there is nothing to divide voxels around")
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
        """(N,), of the images."""
        return (self.coarse.num_voxels + self.fine.num_voxels,)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Of the coarse voxels, (x, y, z) in mm."""
        return self.coarse.spacing

    @property
    def active(self) -> Tensor:
        """1 for the entries (N,) of an image that are voxels, 0 for those that hold nothing."""
        return self.join((~self.divided).float(), self.within.float())

    def split(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The coarse (D, H, W) and the fine values (d, h, w) of an image (N,); views of it."""
        if tuple(image.shape) != self.shape:
            raise ValueError(f"image must have shape {self.shape}, got {tuple(image.shape)}")
        coarse, fine = image.split([self.coarse.num_voxels, self.fine.num_voxels])
        return coarse.view(self.coarse.shape), fine.view(self.fine.shape)

    def join(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """The image (N,) of coarse values (D, H, W) and fine ones (d, h, w); what is no voxel becomes 0."""
        return torch.cat([(coarse * ~self.divided).flatten(), (fine * self.within).flatten()])

    def divide(self, volume: Tensor) -> Tensor:
        """The image (N,) of a coarse volume (D, H, W), interpolated where voxels are divided."""
        return self.join(volume, self.interpolated(volume))

    def volumes(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """An image (N,) as two whole volumes to look at, (D, H, W) and (d, h, w).

        Divided voxels have the mean of their parts, and between coarse voxels the fine ones are interpolated.
        """
        coarse, fine = self.split(image)
        filled = self.with_means(coarse, fine)
        return filled, torch.where(self.within, fine, self.interpolated(filled))

    def with_means(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """The coarse values (D, H, W), where voxels are divided the means of their parts."""
        filled = coarse.clone()
        filled[self.box] = torch.where(self.divided[self.box], means(fine, self.factor), coarse[self.box])
        return filled

    def interpolated(self, coarse: Tensor) -> Tensor:
        """Coarse values (D, H, W) at the fine voxels of the box, (d, h, w), linearly between the voxels' centres."""
        return interpolate(coarse[self.box][None, None], scale_factor=self.factor, mode="trilinear")[0, 0]

    def interpolated_adjoint(self, fine: Tensor) -> Tensor:
        """The adjoint of `interpolated` without its zeros: fine values (d, h, w) to the coarse voxels of the box."""
        for dim in (2, 1, 0):
            fine = _shared(fine, self.factor, dim)
        return fine

    def __repr__(self) -> str:
        return f"TwoLevelGrid({self.coarse}, {int(self.divided.sum())} divided, factor={self.factor})"


def means(fine: Tensor, factor: int) -> Tensor:
    """The means (d, h, w) of blocks of factor^3 fine values."""
    return avg_pool3d(fine[None, None], factor)[0, 0]


def repeated(coarse: Tensor, factor: int) -> Tensor:
    """Each value (d, h, w) factor^3 times: the fine values of blocks."""
    wide = coarse[:, None, :, None, :, None].expand(-1, factor, -1, factor, -1, factor)
    return wide.reshape([count * factor for count in coarse.shape])


def _shared(fine: Tensor, factor: int, dim: int) -> Tensor:
    """The adjoint of linear interpolation along a dimension, from each coarse value to `factor` fine ones."""
    offsets = (torch.arange(factor, dtype=fine.dtype, device=fine.device) - (factor - 1) / 2) / factor
    weights = torch.stack([1 - offsets.abs(), (-offsets).clamp_min(0), offsets.clamp_min(0)], dim=-1)
    own, before, after = torch.tensordot(fine.unflatten(dim, (-1, factor)), weights, dims=([dim + 1], [0])).unbind(-1)
    own, last = own.clone(), own.shape[dim] - 1
    own.narrow(dim, 0, last).add_(before.narrow(dim, 1, last))
    own.narrow(dim, 1, last).add_(after.narrow(dim, 0, last))
    own.narrow(dim, 0, 1).add_(before.narrow(dim, 0, 1))  # beyond the ends is what is at the ends
    own.narrow(dim, last, 1).add_(after.narrow(dim, last, 1))
    return own

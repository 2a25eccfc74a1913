"""Access to a scan's views by blocks, from memory or a reader, and working arrays in memory or on disk."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as distributed
from torch import Tensor

ReadViews = Callable[[list[int]], tuple[Tensor, Tensor | None]]


@dataclass(frozen=True)
class ViewShard:
    """Views that this process works on; over all processes each view occurs once.

    Each process holds the whole volume and needs only the projections of its shard. Sums over views become sums over
    processes (`all_reduce`, Gloo or NCCL), so n processes share the work. Results agree with those of a single process
    to rounding.

    Attributes:
        views: This process's views.
        group: Process group; the default group if None. Without torch.distributed `sum` changes nothing.

    >>> ViewShard.of(10).views == list(range(10))
    True
    """

    views: list[int]
    group: distributed.ProcessGroup | None = None

    @classmethod
    def of(cls, num_views: int, *, group: distributed.ProcessGroup | None = None) -> ViewShard:
        """Every n-th view for n processes; all views if torch.distributed is not running."""
        if not _running():
            return cls(list(range(num_views)))
        rank, size = distributed.get_rank(group), distributed.get_world_size(group)
        return cls(list(range(rank, num_views, size)), group)

    def within(self, views: Sequence[int]) -> ViewShard:
        """Shard of a selection of views, with indices into the selection."""
        shard_views = set(self.views)
        return ViewShard([i for i, view in enumerate(views) if view in shard_views], self.group)

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum the tensor over the processes, in place."""
        if _running():
            distributed.all_reduce(tensor, group=self.group)
        return tensor


def _running() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def views_reader(transmission: Tensor | ReadViews, mask: Tensor | None, shape: Sequence[int]) -> ReadViews:
    """Function that returns transmission and mask, (v, rows, cols), of given views; mask None if all pixels are valid.

    Args:
        transmission: Transmission of all views, (V, rows, cols), or already such a function.
        mask: 0 where a pixel holds no measurement, (V, rows, cols); all pixels are valid if None.
        shape: Expected shape (V, rows, cols).

    Raises:
        ValueError: If a shape is wrong, or a mask is given in addition to a function, which returns its own masks.
    """
    if not isinstance(transmission, Tensor):
        if mask is not None:
            raise ValueError("a function of views also returns their masks: leave out mask")
        return transmission
    for name, tensor in (("transmission", transmission), ("mask", mask)):
        if tensor is not None and tuple(tensor.shape) != tuple(shape):
            raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(tensor.shape)}")

    def read(views: list[int]) -> tuple[Tensor, Tensor | None]:
        return transmission[views], None if mask is None else mask[views]

    return read


class Workspace:
    """Allocates large arrays of a scan in memory or as memory-mapped files in a folder.

    Args:
        folder: An existing folder; memory if None. The files are unlinked as soon as they are open, so no files remain.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder

    def empty(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Uninitialised array of the given shape, with the type of `like`.

        Raises:
            OSError: If the folder's disk has not enough free space.
        """
        if self.folder is None:
            return like.new_empty(tuple(shape))
        size = math.prod(int(count) for count in shape)
        needed, free = size * like.element_size(), shutil.disk_usage(self.folder).free
        if needed > free:  # writing a mapped file to a full disk would kill the process
            raise OSError(f"{self.folder} has room for {free / 2**30:.1f} GiB, {needed / 2**30:.1f} GiB are needed")
        path = self.folder / f"array-{os.getpid()}-{size}"
        array = torch.from_file(str(path), shared=True, size=size, dtype=like.dtype, device="cpu")
        path.unlink()
        return array.view(tuple(shape))

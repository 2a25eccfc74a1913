"""The views of a scan, block by block, from memory or as they are read; what is made of them, in memory or on disk."""

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
    """The views that this process works on; all processes together have each view once.

    Each process holds the whole volume and, if it likes, only its own projections. Sums over views are sums over
    processes (`all_reduce`, Gloo or NCCL): a scan takes its share of time, and results agree with those of one process
    to rounding.

    Attributes:
        views: this process's views.
        group: the processes; the default group if None. Without torch.distributed a shard sums nothing.

    >>> ViewShard.of(10).views == list(range(10))
    True
    """

    views: list[int]
    group: distributed.ProcessGroup | None = None

    @classmethod
    def of(cls, num_views: int, *, group: distributed.ProcessGroup | None = None) -> ViewShard:
        """Every n-th view, n the number of processes; all views where torch.distributed is not running."""
        if not _running():
            return cls(list(range(num_views)))
        rank, size = distributed.get_rank(group), distributed.get_world_size(group)
        return cls(list(range(rank, num_views, size)), group)

    def within(self, views: Sequence[int]) -> ViewShard:
        """The shard of a selection of views, counted within the selection."""
        own = set(self.views)
        return ViewShard([i for i, view in enumerate(views) if view in own], self.group)

    def sum(self, tensor: Tensor) -> Tensor:
        """The tensor summed over the processes, in place."""
        if _running():
            distributed.all_reduce(tensor, group=self.group)
        return tensor


def _running() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def views_reader(transmission: Tensor | ReadViews, mask: Tensor | None, shape: Sequence[int]) -> ReadViews:
    """A function of views that gives their transmission and mask, both (v, rows, cols), or None where all pixels hold.

    Args:
        transmission: of all views, (V, rows, cols), or such a function already.
        mask: 0 where a pixel holds no measurement, (V, rows, cols); every pixel does if None.
        shape: (V, rows, cols) as they must be.

    Raises:
        ValueError: a transmission of another shape, or a mask beside a function, which gives its own.
    """
    if not isinstance(transmission, Tensor):
        if mask is not None:
            raise ValueError("a function of views gives their masks as well: leave out mask")
        return transmission
    for name, tensor in (("transmission", transmission), ("mask", mask)):
        if tensor is not None and tuple(tensor.shape) != tuple(shape):
            raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(tensor.shape)}")

    def read(views: list[int]) -> tuple[Tensor, Tensor | None]:
        return transmission[views], None if mask is None else mask[views]

    return read


class Workspace:
    """Where large arrays of a scan go: memory, or files in a folder, of which the system keeps what fits in memory.

    Args:
        folder: an existing folder; memory if None. The arrays' files are unlinked as soon as they are open, so that
            nothing is left behind.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder

    def empty(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """An array of a shape, of another's type, to be filled.

        Raises:
            OSError: the folder's disk has no room for it.
        """
        if self.folder is None:
            return like.new_empty(tuple(shape))
        size = math.prod(int(count) for count in shape)
        needed, free = size * like.element_size(), shutil.disk_usage(self.folder).free
        if needed > free:  # a mapped file that outgrows its disk would end the process
            raise OSError(f"{self.folder} has room for {free / 2**30:.1f} GiB, {needed / 2**30:.1f} GiB are needed")
        path = self.folder / f"array-{os.getpid()}-{size}"
        array = torch.from_file(str(path), shared=True, size=size, dtype=like.dtype, device="cpu")
        path.unlink()
        return array.view(tuple(shape))

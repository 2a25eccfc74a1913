"""Views shared out over the processes of torch.distributed; sums over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch.distributed as distributed
from torch import Tensor


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

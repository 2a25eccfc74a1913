"""Several processes that share the views of a scan."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as distributed


@contextmanager
def processes() -> Iterator[int]:
    """The rank of this process; torch.distributed runs inside where ``torchrun`` started several."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield 0
        return
    started = not distributed.is_initialized()
    if started:
        distributed.init_process_group("gloo")
    try:
        yield distributed.get_rank()
    finally:
        if started:
            distributed.destroy_process_group()

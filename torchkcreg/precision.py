"""What keeps its precision: operations under autocast, and the poses and matrices of modules."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

_Function = TypeVar("_Function", bound=Callable[..., Any])


def full_precision(function: _Function) -> _Function:
    """The function with `torch.autocast` switched off, and what layers before it made of half precision as float32.

    A pixel coordinate in the hundreds has three digits in bfloat16, and a path length is a difference of large sums.
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        tensors = [x for x in (*args, *kwargs.values()) if isinstance(x, Tensor)]
        device = tensors[0].device.type if tensors else "cpu"
        if device not in _DEVICES or not torch.is_autocast_enabled(device):
            return function(*args, **kwargs)
        with torch.autocast(device, enabled=False):
            return function(*map(_single, args), **{name: _single(value) for name, value in kwargs.items()})

    return wrapped  # type: ignore[return-value]


_DEVICES = ("cpu", "cuda")
_HALF = (torch.float16, torch.bfloat16)


def _single(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in _HALF else value


class ExactModule(nn.Module):
    """A module some of whose buffers follow it to other devices but keep their precision whatever it is cast to.

    A pose in single precision is off by micrometres, a projection matrix by thousandths of a pixel.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ExactModule:
        kept = {name: getattr(self, name) for name in self.exact_buffers}
        super()._apply(fn, recurse)
        for name, value in kept.items():
            moved = getattr(self, name)
            if moved.dtype != value.dtype:  # follow .to(device), but not .float()
                setattr(self, name, value.to(moved.device))
        return self

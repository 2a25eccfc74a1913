"""Keeps full precision: of operations under autocast, and of the poses and matrices of modules."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

_Function = TypeVar("_Function", bound=Callable[..., Any])


def full_precision(function: _Function) -> _Function:
    """Decorator: runs a function with `torch.autocast` off and half-precision tensors converted to float32.

    bfloat16 has two to three significant digits. That is too few for pixel coordinates in the hundreds, and for path
    lengths, which are differences of large sums.
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
    """Module whose `exact_buffers` move to other devices with it but keep their precision when it is cast.

    In single precision a pose is off by micrometres and a projection matrix by thousandths of a pixel.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ExactModule:
        exact = {name: getattr(self, name) for name in self.exact_buffers}
        super()._apply(fn, recurse)
        for name, value in exact.items():
            moved = getattr(self, name)
            if moved.dtype != value.dtype:  # follow .to(device), but not .float()
                setattr(self, name, value.to(moved.device))
        return self

"""Operations that compute in single precision or better under autocast: half of it is not enough for them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

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

"""The backends there are, and which one serves a request."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .extension import unavailable_reason

_LIBRARY = torch.library.Library("torchkcreg", "FRAGMENT")
_TRITON = frozenset(
    (
        "blur",
        "point_drr",
        "spline_evaluate",
        "transmission",
        "voxel_project",
        "voxel_backproject",
        "voxel_backproject_weighted",
    )
)


class Operator:
    """An operator ``torch.ops.torchkcreg.<name>``: what it is called with, what comes out, and a readable definition.

    The definition serves every device for which no backend has a kernel; backends register theirs with the dispatcher,
    in C++ or in Python. Derivatives are not the operator's, see `torchkcreg.kernels.differentiable`.

    Args:
        schema: Name and arguments, as `torch.library` takes them.
        reference: The definition in plain torch, differentiable by autograd.
        fake: Empty results of the right shapes, for tracing.
    """

    def __init__(self, schema: str, *, reference: Callable[..., Any], fake: Callable[..., Any]) -> None:
        self.name, self.reference = schema.partition("(")[0], reference
        _LIBRARY.define(schema)
        _LIBRARY.impl(self.name, reference, "CompositeExplicitAutograd")
        torch.library.register_fake(f"torchkcreg::{self.name}", fake)

    @staticmethod
    def register(kernels: Mapping[str, Callable[..., Any]], device: str) -> None:
        """Gives the dispatcher kernels, by the names of their operators, for a type of device such as "CUDA"."""
        for name, kernel in kernels.items():
            _LIBRARY.impl(name, kernel, device)

    @property
    def dispatched(self) -> Callable[..., Any]:
        """The operator as torch dispatches it, by the device of its arguments."""
        return getattr(torch.ops.torchkcreg, self.name)


@dataclass(frozen=True)
class Backend:
    """Something that computes operators on some devices.

    Attributes:
        name: What users call it.
        devices: Types of devices that it serves, such as "cpu"; None: every one.
        unavailable: Makes its kernels ready at the first call; None, or why they cannot be had.
        operators: Names of the operators that it has kernels for; None: all.
        is_reference: It is the readable definition, correct and slow.
    """

    name: str
    devices: frozenset[str] | None
    unavailable: Callable[[], str | None]
    operators: frozenset[str] | None = None
    is_reference: bool = False

    def serves(self, device: str, operator: str | None) -> bool:
        """Whether it has a kernel of an operator for a type of device."""
        on_device = self.devices is None or device in self.devices
        return on_device and (operator is None or self.operators is None or operator in self.operators)


@functools.cache
def _triton_unavailable() -> str | None:
    """None where Triton's kernels are the dispatcher's, else why they are not."""
    try:
        from .gpu import KERNELS
    except ImportError as error:
        return f"{error}; pip install triton"
    Operator.register(KERNELS, "CUDA")
    return None


# The first that serves a request is what "auto" takes.
BACKENDS: tuple[Backend, ...] = (
    Backend("cpp", frozenset({"cpu"}), unavailable_reason),
    Backend("triton", frozenset({"cuda"}), _triton_unavailable, operators=_TRITON),
    Backend("torch", None, lambda: None, is_reference=True),
)


def backend_names() -> tuple[str, ...]:
    """What a user may ask for."""
    return ("auto", *(backend.name for backend in BACKENDS))


def choose_backend(data: Tensor, name: str = "auto", *, operator: str | None = None) -> Backend:
    """The backend that serves a request on the device of the data.

    Where "auto" ends at the slow reference on a device that could have kernels, a warning says so, once.

    Args:
        data: What is computed with.
        name: "auto", or one of the backends.
        operator: Name of the operator; any if None.

    Raises:
        ValueError: for a backend that does not exist, or does not serve the device of the data or the operator.
        OSError: for one that is asked for by name and whose kernels cannot be had.
    """
    if name not in backend_names():
        raise ValueError(f"backend must be one of {', '.join(backend_names())}, got {name!r}")
    device = data.device.type
    asked = [backend for backend in BACKENDS if name in ("auto", backend.name)]
    able = [backend for backend in asked if backend.serves(device, operator)]
    if not able:
        only = " or ".join("the CPU" if kind == "cpu" else kind for kind in sorted(asked[0].devices or ()))
        raise ValueError(f'backend "{name}" needs tensors on {only}, got {data.device}')
    for backend in able:
        reason = backend.unavailable()
        if reason is None:
            if name == "auto" and backend.is_reference and device not in ("cpu", "meta"):
                _warn_of_reference(device)
            return backend
    raise OSError(f'the kernels of backend "{name}" are not available: {reason}')


def kernel(operator: Operator, data: Tensor, backend: str) -> Callable[..., Any]:
    """What computes an operator for a request; no derivative may be asked of it but of the reference."""
    chosen = choose_backend(data, backend, operator=operator.name)
    return operator.reference if chosen.is_reference else operator.dispatched


@functools.cache
def _warn_of_reference(device: str) -> None:
    warnings.warn(
        f"there are no kernels for {device}: torchkcreg runs on its readable reference there, many times slower",
        stacklevel=4,
    )

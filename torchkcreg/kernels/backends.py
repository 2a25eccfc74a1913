"""Operators, the available backends, and the choice of a backend."""

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
    """Operator `torch.ops.torchkcreg.<name>`: its schema, the shapes of its results, and a reference in plain torch.

    The reference is used on every device for which no backend has a kernel. Backends register their kernels with the
    dispatcher, in C++ or in Python. Operators have no derivatives, see `torchkcreg.kernels.differentiable`.

    Args:
        schema: Name and arguments, in the form of `torch.library`.
        reference: Implementation in plain torch, differentiable by autograd.
        fake: Returns empty results of the right shapes, for tracing.
    """

    def __init__(self, schema: str, *, reference: Callable[..., Any], fake: Callable[..., Any]) -> None:
        self.name, self.reference = schema.partition("(")[0], reference
        _LIBRARY.define(schema)
        _LIBRARY.impl(self.name, reference, "CompositeExplicitAutograd")
        torch.library.register_fake(f"torchkcreg::{self.name}", fake)

    @staticmethod
    def register(kernels: Mapping[str, Callable[..., Any]], device: str) -> None:
        """Register kernels, by the names of their operators, for a type of device such as "CUDA"."""
        for name, kernel in kernels.items():
            _LIBRARY.impl(name, kernel, device)

    @property
    def dispatched(self) -> Callable[..., Any]:
        """Operator that torch dispatches by the device of its arguments."""
        return getattr(torch.ops.torchkcreg, self.name)


@dataclass(frozen=True)
class Backend:
    """Set of kernels for some types of devices.

    Attributes:
        name: Name for users.
        devices: Supported types of devices, such as "cpu". None: all.
        unavailable: Loads the kernels at the first call. Returns None, or the reason why they are not available.
        operators: Names of the operators that it has kernels for. None: all.
        is_reference: True for the readable reference, which is correct but slow.
    """

    name: str
    devices: frozenset[str] | None
    unavailable: Callable[[], str | None]
    operators: frozenset[str] | None = None
    is_reference: bool = False

    def serves(self, device: str, operator: str | None) -> bool:
        """True if it has a kernel of the operator (None: any) for a type of device."""
        on_device = self.devices is None or device in self.devices
        return on_device and (operator is None or self.operators is None or operator in self.operators)


@functools.cache
def _triton_unavailable() -> str | None:
    """Register Triton's kernels. Returns None, or the reason why they are not available."""
    try:
        from .gpu import KERNELS
    except ImportError as error:
        return f"{error}; pip install triton"
    Operator.register(KERNELS, "CUDA")
    return None


# "auto" takes the first that has a kernel.
BACKENDS: tuple[Backend, ...] = (
    Backend("cpp", frozenset({"cpu"}), unavailable_reason),
    Backend("triton", frozenset({"cuda"}), _triton_unavailable, operators=_TRITON),
    Backend("torch", None, lambda: None, is_reference=True),
)


def backend_names() -> tuple[str, ...]:
    """Names that a user may choose."""
    return ("auto", *(backend.name for backend in BACKENDS))


def choose_backend(data: Tensor, name: str = "auto", *, operator: str | None = None) -> Backend:
    """Backend for an operator on the device of the data.

    Warns once if "auto" falls back to the slow reference on a device other than the CPU.

    Args:
        data: Tensor on the device to compute on.
        name: "auto" or the name of a backend.
        operator: Name of the operator. None: any.

    Raises:
        ValueError: If the backend does not exist, or does not support the operator or the device of the data.
        OSError: If the kernels of a backend chosen by name are not available.
    """
    if name not in backend_names():
        raise ValueError(f"backend must be one of {', '.join(backend_names())}, got {name!r}")
    device = data.device.type
    candidates = [backend for backend in BACKENDS if name in ("auto", backend.name)]
    suitable = [backend for backend in candidates if backend.serves(device, operator)]
    if not suitable:
        only = " or ".join("the CPU" if kind == "cpu" else kind for kind in sorted(candidates[0].devices or ()))
        raise ValueError(f'backend "{name}" needs tensors on {only}, got {data.device}')
    for backend in suitable:
        reason = backend.unavailable()
        if reason is None:
            if name == "auto" and backend.is_reference and device not in ("cpu", "meta"):
                _warn_of_reference(device)
            return backend
    raise OSError(f'the kernels of backend "{name}" are not available: {reason}')


def kernel(operator: Operator, data: Tensor, backend: str) -> Callable[..., Any]:
    """Function that computes an operator with the chosen backend. Only the reference is differentiable."""
    chosen = choose_backend(data, backend, operator=operator.name)
    return operator.reference if chosen.is_reference else operator.dispatched


@functools.cache
def _warn_of_reference(device: str) -> None:
    warnings.warn(
        f"there are no kernels for {device}: torchkcreg runs on its readable reference there, many times slower",
        stacklevel=4,
    )

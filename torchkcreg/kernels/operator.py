"""One operator of torch's dispatcher, whatever computes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

_LIBRARY = torch.library.Library("torchkcreg", "FRAGMENT")


class Operator:
    """An operator ``torch.ops.torchkcreg.<name>``: what it is called with, what comes out, and a readable definition.

    The definition serves every device for which no backend has a kernel; backends register theirs with the dispatcher,
    in C++ or in Python. Derivatives are not the operator's, see `torchkcreg.differentiable`.

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

"""Operators of torch's dispatcher (`torch.ops.torchkcreg`) and their backends.

There is a readable reference in plain torch for any device, C++ for CPUs (sources in `csrc`) and Triton for GPUs (in
`gpu`). Derivatives are in `differentiable`.
"""

from .backends import BACKENDS, Backend, Operator, backend_names, choose_backend, kernel
from .extension import PACKAGE, unavailable_reason

__all__ = [
    "BACKENDS",
    "PACKAGE",
    "Backend",
    "Operator",
    "backend_names",
    "choose_backend",
    "kernel",
    "unavailable_reason",
]

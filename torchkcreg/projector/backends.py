"""Which backend serves a request, and the compiled operators with their fake kernels and autograd.

Schemas are in ``csrc/ops.cpp``, kernels in ``csrc/cpu``. They are loaded at first use, never at import.
"""

from __future__ import annotations

import functools

from torch import Tensor

from . import extension

BACKENDS = ("auto", "cpp", "torch")


def choose_backend(data: Tensor, backend: str) -> str:
    """The backend, "cpp" or "torch", that serves a request on the device of the data.

    Raises:
        ValueError: for a backend that does not exist or does not serve the device of the data.
        OSError: for ``backend="cpp"`` where the kernels are neither built nor can be compiled.
    """
    if backend == "triton":
        raise ValueError('backend "triton" is not available')
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    on_cpu = data.device.type == "cpu"
    if backend == "cpp" and not on_cpu:
        raise ValueError(f'backend "cpp" needs tensors on the CPU, got {data.device}')
    if backend == "torch" or not on_cpu:
        return "torch"
    reason = load_operators()
    if reason is None:
        return "cpp"
    if backend == "cpp":
        raise OSError(f"the C++ kernels are not available: {reason}")
    return "torch"


@functools.lru_cache(maxsize=1)
def load_operators() -> str | None:
    """None once ``torch.ops.torchkcreg`` is ready, else why it can't be."""
    reason = extension.unavailable_reason()
    if reason is None:
        from . import ops, voxel_ops  # they choose their backend here, hence not at import

        ops.register()
        voxel_ops.register()
    return reason

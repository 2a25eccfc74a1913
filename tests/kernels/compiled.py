"""Compiles every Triton kernel for a GPU that need not be there, in single and double precision."""

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from torchkcreg.kernels.gpu import beam, filters, points, splines, voxels

TARGET = GPUTarget("cuda", 90, 32)
CONSTANTS = {
    points._splat: {"TAPS": 4, "PHASES": 16, "NODES": 128},
    points._gather: {"TAPS": 4, "PHASES": 16, "NODES": 128, "MATRICES": True},
    filters._along: {"TAPS": 11, "TRANSPOSED": True, "PIXELS": 256},
    splines._evaluate: {"X": 0, "Y": 1, "Z": 2, "POINTS": 128},
    voxels._walk: {"PIXELS": 128, "ADJOINT": True},
    voxels._gather_views: {"VOXELS": 256},
    beam._signal: {"MATERIALS": 2, "PIXELS": 256},
    beam._gradients: {"MATERIALS": 2, "PIXELS": 256},
}
POINTERS = {
    "points", "volumes", "matrices", "table", "images", "grad", "to_points", "to_volumes", "to_matrices", "kernel",
    "result", "eta", "features", "lengths", "attenuation", "weights", "upstream", "to_lengths", "to_weights", "moments",
    "volume",
}  # fmt: skip


def signature(kernel: triton.JITFunction, number: str) -> dict[str, str]:
    """Types of a kernel's arguments."""
    kinds = {name: f"*{number}" if name in POINTERS else "i32" for name in kernel.arg_names}
    kinds |= {"cells": "*i64"} if "cells" in kinds else {}
    kinds |= dict.fromkeys({"rays", "spacing"} & set(kinds), "*fp64")
    kinds |= {"matrices": "*fp64"} if kernel is voxels._gather_views else {}
    return kinds | dict.fromkeys(CONSTANTS[kernel], "constexpr")


for kernel, constants in CONSTANTS.items():
    for number in ("fp32", "fp64"):
        source = ASTSource(fn=kernel, signature=signature(kernel, number), constexprs=constants)
        made = triton.compile(source, target=TARGET)
        assert ".visible .entry" in made.asm["ptx"]
        print(kernel.fn.__module__, kernel.fn.__name__, number, made.metadata.shared, "bytes shared", flush=True)
print("all kernels compile")

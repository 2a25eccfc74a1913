"""Find the library of compiled kernels, or build it at first use."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

PACKAGE = Path(__file__).resolve().parent.parent
SOURCES = (
    "csrc/cpu/blur.cpp",
    "csrc/cpu/mesh_lengths.cpp",
    "csrc/cpu/point_drr.cpp",
    "csrc/cpu/splines.cpp",
    "csrc/cpu/transmission.cpp",
    "csrc/cpu/voxel_project.cpp",
    "csrc/cpu/voxel_backproject.cpp",
    "csrc/cpu/voxel_backproject_weighted.cpp",
)
# setup.py reads these too. The target version lets one build serve torch 2.10 and every later release.
DEFINES = ("-DTORCH_TARGET_VERSION=0x020a000000000000",)
COMPILE_FLAGS = (
    ("/O2", "/std:c++17")
    if os.name == "nt"
    else ("-O3", "-g0", "-std=c++17", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden", "-Wno-psabi")
)


@functools.lru_cache(maxsize=1)
def unavailable_reason() -> str | None:
    """Load or compile the kernels at the first call. Returns None, or the reason why they are not available.

    A library built with the package is tried first. If there is none, or it does not load (other version of torch,
    other machine), the sources are compiled into the user's cache of torch extensions. If that fails too, a warning
    says once how to fix it, and the torch reference is used.
    """
    reasons = []
    for load in (_load_built, _load_compiled):
        failure = _failure_of(load)
        if failure is None:
            return None
        reasons.append(failure)
    reason = "; ".join(reasons)
    warnings.warn(
        f"torchkcreg runs on its slow torch reference, because its C++ kernels are not available ({reason}). Install a "
        "C++17 compiler and ninja, then reinstall with: pip install --no-build-isolation --force-reinstall --no-deps "
        "torchkcreg",
        stacklevel=2,
    )
    return reason


def _failure_of(load: Callable[[], None]) -> str | None:
    try:
        load()
    except Exception as error:  # loaders, compilers and caches fail in many ways; the reference is the fallback
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return lines[0]
    return None


def _load_built() -> None:
    for library in sorted(PACKAGE.glob("_C*.so")) + sorted(PACKAGE.glob("_C*.pyd")):
        torch.ops.load_library(str(library))
        return
    raise FileNotFoundError(f"no built library in {PACKAGE}")


def _load_compiled() -> None:
    from torch.utils import cpp_extension  # slow to import and rarely needed

    sources = [PACKAGE / source for source in SOURCES]
    missing = [str(source) for source in sources if not source.is_file()]
    if missing:
        raise FileNotFoundError(f"no source {missing[0]}")
    cpp_extension.load(
        "torchkcreg_kernels",
        [str(source) for source in sources],
        extra_cflags=[*COMPILE_FLAGS, *DEFINES],
        is_python_module=False,
    )

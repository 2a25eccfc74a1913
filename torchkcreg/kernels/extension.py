"""Find the library of compiled kernels, or build it at first use."""

from __future__ import annotations

import functools
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

log = logging.getLogger(__name__)
NAME = "torchkcreg_kernels"
PATIENCE_SECONDS = 5.0
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
    root = os.environ.get("TORCH_EXTENSIONS_DIR") or cpp_extension.get_default_build_root()
    folder = Path(root) / f"{NAME}_{torch.__version__}"
    folder.mkdir(parents=True, exist_ok=True)
    with only_one(folder / "torchkcreg.lock"):
        # whoever compiles holds our lock, so a lock of torch's is that of a process that was killed
        (folder / "lock").unlink(missing_ok=True)
        cpp_extension.load(
            NAME,
            [str(source) for source in sources],
            extra_cflags=[*COMPILE_FLAGS, *DEFINES],
            build_directory=str(folder),
            is_python_module=False,
        )


@contextmanager
def only_one(lock: Path) -> Iterator[None]:
    """Hold a lock file that ends with its process; says so once if another process holds it for long."""
    from filelock import FileLock, Timeout  # torch requires it

    held = FileLock(lock)
    try:
        held.acquire(timeout=PATIENCE_SECONDS)
    except Timeout:
        log.warning("another process compiles torchkcreg's kernels: waiting for it (%s)", lock)
        held.acquire()
    try:
        yield
    finally:
        held.release()

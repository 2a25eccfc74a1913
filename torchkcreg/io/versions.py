"""What a run was made with."""

from __future__ import annotations

import importlib.metadata
import platform

import torch

_PACKAGES = ("torchkcreg", "torch", "numpy", "scipy", "kornia", "cma", "trimesh", "SimpleITK", "pydantic")


def versions() -> dict[str, str | int]:
    """Versions of Python, of the packages the numbers depend on, of the machine, and the number of threads.

    >>> sorted(versions())[:3]
    ['SimpleITK', 'cma', 'kornia']
    """
    found: dict[str, str | int] = {package: _version(package) for package in _PACKAGES}
    return {
        **found,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": platform.machine(),
        "threads": torch.get_num_threads(),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed as a package"

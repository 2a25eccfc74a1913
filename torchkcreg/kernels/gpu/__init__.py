"""Kernels for GPUs, written in Triton, by the names of their operators.

If `TRITON_INTERPRET=1` is set before Triton is first imported, they run, slowly, on CPU tensors.
"""

from collections.abc import Callable
from typing import Any

from .beam import transmission, transmission_backward
from .filters import blur
from .points import point_drr, point_drr_backward
from .splines import spline_evaluate
from .voxels import voxel_backproject, voxel_backproject_weighted, voxel_project

KERNELS: dict[str, Callable[..., Any]] = {
    "blur": blur,
    "point_drr": point_drr,
    "point_drr_backward": point_drr_backward,
    "spline_evaluate": spline_evaluate,
    "transmission": transmission,
    "transmission_backward": transmission_backward,
    "voxel_project": voxel_project,
    "voxel_backproject": voxel_backproject,
    "voxel_backproject_weighted": voxel_backproject_weighted,
}

__all__ = ["KERNELS"]

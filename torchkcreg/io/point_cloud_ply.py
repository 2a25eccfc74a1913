"""Point clouds with their fields, as `write_point_cloud_ply` writes them."""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from torchkcreg.io.files import existing_file

LONGEST_HEADER = 4096  # bytes


def read_point_cloud_ply(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Columns (N,) of a binary PLY of this library by their names: x, y, z, and dx, dy, dz, displacement, std if there.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is another kind of PLY, or shorter than its header says.
    """
    content = existing_file(path, "point cloud").read_bytes()
    end = content.find(b"end_header\n", 0, LONGEST_HEADER)
    lines = content[:end].decode("ascii", errors="replace").splitlines()
    if end < 0 or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ValueError(f"point cloud file {path} is no binary PLY")
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    body = content[end + len(b"end_header\n") :]
    if len(counts) != 1 or not counts[0].isdigit() or names[:3] != ["x", "y", "z"]:
        raise ValueError(f"point cloud file {path} has no vertices of floats x, y, z")
    if len(body) != int(counts[0]) * 4 * len(names):
        raise ValueError(f"point cloud file {path} does not hold the {counts[0]} points that its header says")
    table = np.frombuffer(body, dtype="<f4").reshape(-1, len(names))
    return {name: torch.from_numpy(table[:, i].copy()) for i, name in enumerate(names)}

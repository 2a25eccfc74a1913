"""The initial pose of an implant as JSON: a rigid 4x4 `implant_to_world` matrix."""

from __future__ import annotations

import os

import torch
from torch import Tensor

from torchkcreg.io.files import read_json, write_json
from torchkcreg.plain import finite_array

ROUNDING = 2e-3


def read_init(path: str | os.PathLike[str]) -> Tensor:
    """The rigid transform (4, 4) float64 from the implant's frame to the world, mm.

    The file holds `{"implant_to_world": [[...] x 4]}`, or the four rows alone. Rows with a few decimals make a rotation
    that is one only nearly: the nearest proper rotation takes its place, about the same translation.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the matrix is missing, scales, shears, mirrors, or projects.
    """
    content = read_json(path, "initial pose")
    if isinstance(content, dict):
        if "implant_to_world" not in content:
            raise ValueError(f"initial pose file {path} has no 'implant_to_world'")
        content = content["implant_to_world"]
    try:
        return rigid(finite_array(content, (4, 4), "implant_to_world"), "implant_to_world")
    except ValueError as error:
        raise ValueError(f"initial pose file {path}: {error}") from error


def write_init(path: str | os.PathLike[str], implant_to_world: Tensor) -> None:
    """Nothing; writes a pose as `read_init` reads it."""
    write_json(path, {"implant_to_world": rigid(implant_to_world.detach().cpu().double(), "implant_to_world")})


def rigid(matrix: Tensor, name: str, *, tolerance: float = ROUNDING) -> Tensor:
    """The exactly rigid matrix (4, 4) nearest to one that is rigid up to rounding.

    Args:
        matrix: (4, 4) float64.
        name: for messages.
        tolerance: largest element of R^T R - I that counts as rounding.

    Raises:
        ValueError: more than rounding is wrong with it, and what.

    >>> rigid(torch.eye(4).double() * 1.0001, "pose")[:3, :3].tolist()
    Traceback (most recent call last):
    ValueError: pose must have the last row 0 0 0 1, got [0.0, 0.0, 0.0, 1.0001]
    """
    last = matrix[3]
    if not torch.equal(last, torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=matrix.dtype)):
        raise ValueError(f"{name} must have the last row 0 0 0 1, got {[round(x, 6) for x in last.tolist()]}")
    rotation = matrix[:3, :3]
    if float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"{name} must not mirror: the determinant of its rotation is negative")
    gram = rotation.mT @ rotation
    if float((gram - torch.eye(3, dtype=matrix.dtype)).abs().max()) > tolerance:
        scales = gram.diagonal().sqrt().tolist()
        raise ValueError(
            f"{name} must be rigid, but its axes have lengths {', '.join(f'{s:.4g}' for s in scales)} "
            f"and scalar products up to {float((gram - gram.diagonal().diag()).abs().max()):.2g}"
        )
    u, _, vh = torch.linalg.svd(rotation)
    exact = matrix.clone()
    exact[:3, :3] = u @ vh
    return exact

"""Files of an implant: its initial pose (rigid 4x4 `implant_to_world`), poses over frames, and screws (cylinders)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.implant import Screw
from torchkcreg.plain import finite_array, finite_number

from .files import read_json, write_json, write_text

ROUNDING = 2e-3


def read_components(path: str | os.PathLike[str]) -> list[Screw]:
    """Read screws (cylinders) from a JSON file.

    The file holds `{"units": "mm", "screws": [{"from", "to", "radius", "material", "name"}, ...]}`. `from` is the head
    end and `to` the tip, each x, y, z in mm in the implant's frame. A `material` beside `screws` is the default for all
    of them. `name` defaults to screw0, screw1, ... Other keys are ignored.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: Units other than mm, a missing key, a cylinder of zero length or non-positive radius, or a duplicate
            name. The message names the file, the screw and the key.
    """
    content = read_json(path, "components")
    try:
        if not isinstance(content, dict) or not isinstance(content.get("screws"), list):
            raise ValueError("must be a JSON object with a list 'screws'")
        if content.get("units", "mm") != "mm":
            raise ValueError(f"units must be mm, got {content['units']!r}")
        screws = [_screw(screw, i, content.get("material")) for i, screw in enumerate(content["screws"])]
        names = [screw.name for screw in screws]
        if duplicates := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"names must be unique, {duplicates[0]!r} is there {names.count(duplicates[0])} times")
    except ValueError as error:
        raise ValueError(f"components file {path}: {error}") from error
    return screws


def write_components(path: str | os.PathLike[str], screws: Sequence[Screw]) -> None:
    """Write screws as a JSON file for `read_components`."""
    listed = [
        {"name": s.name, "from": list(s.start), "to": list(s.end), "radius": s.radius, "material": s.material}
        for s in screws
    ]
    write_json(path, {"units": "mm", "frame": "the undeformed implant's", "screws": listed})


def _screw(screw: Any, i: int, material: Any) -> Screw:
    if not isinstance(screw, dict):
        raise ValueError(f"screw {i} must be an object with from, to, radius and material, got {screw!r}")
    for key in ("from", "to", "radius"):
        if key not in screw:
            raise ValueError(f"screw {i} has no {key!r}")
    start, end = (finite_array(screw[key], (3,), f"{key!r} of screw {i}") for key in ("from", "to"))
    if float((end - start).norm()) < 1e-6:
        raise ValueError(f"screw {i} has no length: 'from' and 'to' are both {start.tolist()}")
    material = screw.get("material", material)
    if not isinstance(material, str) or not material:
        raise ValueError(f"material of screw {i} must be a name, got {material!r}")
    name = screw.get("name", f"screw{i}")
    if not isinstance(name, str) or not name:
        raise ValueError(f"name of screw {i} must be a text, got {name!r}")
    radius = finite_number(screw["radius"], f"radius of screw {i}", positive=True)
    return Screw(_triple(start.tolist()), _triple(end.tolist()), radius, material, name)


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def read_init(path: str | os.PathLike[str]) -> Tensor:
    """The rigid transform (4, 4) float64 from the implant's frame to the world, mm.

    The file holds `{"implant_to_world": [[...] x 4]}`, or the four rows alone; of poses over frames (`.tra`), the first
    frame's is read. Rounded entries are only nearly a rotation, so the nearest rotation is used. The translation is
    unchanged.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The matrix is missing, or it scales, shears, mirrors or projects.
    """
    if Path(path).suffix.lower() == ".tra":
        first = read_tra(path)[0]
        if bool(first.isnan().any()):
            raise ValueError(f"pose file {path} has no pose in its first line")
        return first
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
    """Write an initial pose as a JSON file for `read_init`."""
    write_json(path, {"implant_to_world": rigid(implant_to_world.detach().cpu().double(), "implant_to_world")})


def read_tra(path: str | os.PathLike[str]) -> Tensor:
    """Poses (F, 4, 4) over frames, as Autoscoper saves them: a line a frame, 16 numbers, the matrix row by row.

    NaN stands for frames without a pose.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: A line has not 16 numbers, or its matrix is not rigid; the message names it.
    """
    poses = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        cells = line.replace(",", " ").split()
        if not cells:
            continue
        try:
            matrix = torch.tensor([float(cell) for cell in cells], dtype=torch.float64).reshape(4, 4)
        except (ValueError, RuntimeError):
            raise ValueError(f"pose file {path}, line {number}: 16 numbers are needed, a matrix row by row") from None
        try:
            poses.append(matrix if bool(matrix.isnan().any()) else rigid(matrix, "the matrix"))
        except ValueError as error:
            raise ValueError(f"pose file {path}, line {number}: {error}") from None
    if not poses:
        raise ValueError(f"pose file {path} is empty")
    return torch.stack(poses)


def write_tra(path: str | os.PathLike[str], poses: Tensor) -> None:
    """Write poses (F, 4, 4) over frames for Autoscoper (`read_tra`); NaN stands for frames without one."""
    rows = poses.detach().cpu().double().flatten(1).tolist()
    write_text(path, "".join(",".join(f"{x:.9g}" for x in row).replace("nan", "NaN") + "\n" for row in rows))


def rigid(matrix: Tensor, name: str, *, tolerance: float = ROUNDING) -> Tensor:
    """The rigid matrix (4, 4) nearest to a matrix that is rigid up to rounding.

    Args:
        matrix: (4, 4) float64.
        name: Name of the matrix, for messages.
        tolerance: Largest element of R^T R - I that counts as rounding.

    Raises:
        ValueError: The matrix is not rigid within the tolerance; the message says why.

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

"""Large arrays of a JSON file, stored in an NPZ file; single NPY arrays; check of checkpoint content."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .files import atomic_path

_KEY = "array"
_MOST_IN_JSON = 4096


def without_arrays(content: Any, where: str = "") -> tuple[Any, dict[str, Tensor]]:
    """The content with `{"array": name}` for each tensor of more than 4096 numbers, and these tensors by name."""
    if isinstance(content, Tensor):
        return ({_KEY: where}, {where: content}) if content.numel() > _MOST_IN_JSON else (content, {})
    pairs: Any = {}
    if isinstance(content, dict):
        pairs = content.items()
    elif isinstance(content, (list, tuple)):
        pairs = enumerate(content)
    else:
        return content, {}
    parts = {key: without_arrays(value, f"{where}.{key}" if where else str(key)) for key, value in pairs}
    arrays = {name: array for _, nested in parts.values() for name, array in nested.items()}
    if isinstance(content, dict):
        return {key: part for key, (part, _) in parts.items()}, arrays
    return [part for part, _ in parts.values()], arrays


def with_arrays(content: Any, path: Path) -> Any:
    """The content with its array references replaced by the arrays of an NPZ file.

    Raises:
        FileNotFoundError: The content refers to an array, but the file does not exist.
        ValueError: The file lacks an array or is damaged.
    """
    if not isinstance(content, (dict, list)):
        return content
    if isinstance(content, dict) and content.keys() == {_KEY}:
        return _array(path, content[_KEY])
    if isinstance(content, dict):
        return {key: with_arrays(value, path) for key, value in content.items()}
    return [with_arrays(value, path) for value in content]


def write_arrays(path: Path, arrays: dict[str, Tensor]) -> None:
    """Write an NPZ file atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: array.detach().cpu().numpy() for name, array in arrays.items()})  # type: ignore[arg-type]


def read_array(path: Path) -> Tensor:
    """The array of an NPY file."""
    return torch.from_numpy(np.load(path, allow_pickle=False))


def write_array(path: Path, array: Tensor) -> None:
    """Write an array as an NPY file. The folder is created if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        np.save(temporary, array.numpy())


def require_loadable(content: Any, where: str) -> None:
    """Check that a checkpoint holds only tensors and plain data.

    Args:
        content: The checkpoint or a part of it.
        where: Path of the part, for the error message.

    Raises:
        ValueError: It holds something else.
    """
    if content is None or isinstance(content, (bool, int, float, str)) or type(content) is torch.Tensor:
        return
    if isinstance(content, dict):
        for key, value in content.items():
            require_loadable(value, f"{where}[{key!r}]")
    elif isinstance(content, (list, tuple)):
        for i, value in enumerate(content):
            require_loadable(value, f"{where}[{i}]")
    else:
        raise ValueError(f"a checkpoint holds tensors and plain data, but {where} is a {type(content).__name__}")


def _array(path: Path, name: str) -> Tensor:
    if not path.is_file():
        raise FileNotFoundError(f"arrays file {path}, which a deformation refers to, does not exist")
    try:
        with np.load(path, allow_pickle=False) as stored:
            return torch.from_numpy(stored[name])
    except KeyError:
        raise ValueError(f"arrays file {path} has no array {name!r}") from None
    except Exception as error:  # numpy, zipfile and zlib raise various types
        raise ValueError(f"arrays file {path} cannot be read: {error}") from error

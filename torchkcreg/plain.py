"""Plain types: what JSON, YAML and checkpoints hold, and numbers out of them."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import torch


def plain(content: Any) -> Any:
    """`content` as numbers, strings, lists and dicts: what JSON, YAML and a checkpoint can hold.

    Tensors and arrays become (nested) lists, NumPy scalars numbers, tuples lists, paths strings. JSON knows no NaN
    and no infinity: they become None.

    Raises:
        ValueError: something else is in it; names its type and where it is.
    """
    return _plain(content, "")


def _plain(content: Any, where: str) -> Any:
    if content is None or isinstance(content, (bool, int, str)):
        return content
    if isinstance(content, float):
        return float(content) if math.isfinite(content) else None
    if isinstance(content, torch.Tensor):
        return _plain(content.detach().cpu().tolist(), where)
    if isinstance(content, (np.ndarray, np.generic)):
        return _plain(content.tolist(), where)
    if isinstance(content, os.PathLike):
        return os.fspath(content)
    if isinstance(content, dict):
        return {str(key): _plain(value, f"{where}[{key!r}]") for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value, f"{where}[{i}]") for i, value in enumerate(content)]
    raise ValueError(f"cannot write a {type(content).__name__} as plain data{f' (at {where})' if where else ''}")


def finite_number(value: Any, name: str, *, positive: bool = False) -> float:
    """`value` as a float; ValueError(name ...) when it is no finite number, or not above zero where asked."""
    wanted = "a positive number" if positive else "a finite number"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    if positive and value <= 0:
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    return float(value)


def finite_array(value: Any, shape: tuple[int, ...], name: str) -> torch.Tensor:
    """`value` (nested lists) as a float64 tensor of `shape`; ValueError(name ...) when it is anything else."""
    try:
        array = np.array(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value)
    except ValueError:
        array = np.array(None)
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {' x '.join(map(str, shape))} numbers, got {_short(value)}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_short(value)}")
    return torch.from_numpy(array.astype(np.float64))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def require_keys(content: Any, keys: tuple[str, ...], where: str = "") -> None:
    """ValueError that names the first key which `content`, that should be a dict, lacks."""
    if not isinstance(content, dict):
        raise ValueError(f"what should hold the {keys[0]!r}{where} must be an object, got {type(content).__name__}")
    for key in keys:
        if key not in content:
            raise ValueError(f"{key!r}{where} is missing")

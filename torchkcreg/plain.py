"""Conversion to plain types for JSON, YAML and checkpoints, checks of values read from them, and errors in a line."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import torch


def plain(content: Any) -> Any:
    """`content` as numbers, strings, lists and dicts, for JSON, YAML and checkpoints.

    Tensors and arrays become (nested) lists, NumPy scalars numbers, tuples lists, paths strings. NaN and
    infinity become None, since JSON has neither.

    Raises:
        ValueError: If it holds anything else. The message names the type and its place.
    """
    return _plain(content, "")


def _plain(content: Any, place: str) -> Any:
    if content is None or isinstance(content, (bool, int, str)):
        return content
    if isinstance(content, float):
        return float(content) if math.isfinite(content) else None
    if isinstance(content, torch.Tensor):
        return _plain(content.detach().cpu().tolist(), place)
    if isinstance(content, (np.ndarray, np.generic)):
        return _plain(content.tolist(), place)
    if isinstance(content, os.PathLike):
        return os.fspath(content)
    if isinstance(content, dict):
        return {str(key): _plain(value, f"{place}[{key!r}]") for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value, f"{place}[{i}]") for i, value in enumerate(content)]
    raise ValueError(f"cannot write a {type(content).__name__} as plain data{f' (at {place})' if place else ''}")


def std_key(key: str) -> str:
    """Name of the standard deviation of a number whose name ends in its unit.

    >>> std_key("rotation_x_deg")
    'rotation_x_std_deg'
    """
    return "_std_".join(key.rsplit("_", 1))


def finite_number(value: Any, name: str, *, positive: bool = False) -> float:
    """`value` as a float. Raises ValueError unless it is a finite number, and above zero if `positive`."""
    expected = "a positive number" if positive else "a finite number"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name} must be {expected}, got {value!r}")
    if positive and value <= 0:
        raise ValueError(f"{name} must be {expected}, got {value!r}")
    return float(value)


def finite_array(value: Any, shape: tuple[int, ...], name: str) -> torch.Tensor:
    """`value` (nested lists) as a float64 tensor of `shape`. Raises ValueError if it is anything else."""
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
    """Raise ValueError if `content` is not a dict or lacks a key; the message names the first missing one."""
    if not isinstance(content, dict):
        raise ValueError(f"what should hold the {keys[0]!r}{where} must be an object, got {type(content).__name__}")
    for key in keys:
        if key not in content:
            raise ValueError(f"{key!r}{where} is missing")


def first_line(error: Exception, *, line: int = 0, otherwise: str | None = None) -> str:
    r"""One line of an error's message, the first by default; the error's type, or `otherwise`, if there is no message.

    >>> first_line(ValueError("no header\nat byte 3")), first_line(KeyError(), otherwise="damaged")
    ('no header', 'damaged')
    """
    lines = str(error).strip().splitlines()
    return lines[line] if lines else otherwise or type(error).__name__

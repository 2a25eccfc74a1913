"""Progress bars with the remaining time, which can all be switched off."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

_silent = False


def silence(silent: bool = True) -> None:
    """Switch all progress bars off, also those that are asked for explicitly, or on again."""
    global _silent
    _silent = silent


def progress_bar(iterable: Iterable[Any] | None = None, *, shown: bool | None = None, **options: Any) -> tqdm:
    """Make a `tqdm` progress bar.

    Args:
        iterable: Items to iterate over.
        shown: True to show it. None: only if the output is a terminal.
        options: Options of `tqdm`: total, desc, initial, leave.
    """
    disable = True if _silent else None if shown is None else not shown
    return tqdm(iterable, disable=disable, **options)

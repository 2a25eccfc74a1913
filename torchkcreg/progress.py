"""Progress bars with the time that is left, which one call silences."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

_silent = False


def silence(silent: bool = True) -> None:
    """No bar is shown from now on, whatever a function is asked for; or bars are shown again."""
    global _silent
    _silent = silent


def progress_bar(iterable: Iterable[Any] | None = None, *, shown: bool | None = None, **how: Any) -> tqdm:
    """A `tqdm` bar.

    Args:
        iterable: what it goes through.
        shown: whether it is shown; None where the output is a terminal.
        how: as of `tqdm`: total, desc, initial, leave.
    """
    disable = True if _silent else None if shown is None else not shown
    return tqdm(iterable, disable=disable, **how)

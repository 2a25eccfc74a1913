"""What people read: how a command ends, with warnings of a line each and an error of one line, and tables."""

from __future__ import annotations

import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

WRONG, INTERRUPTED = 2, 130  # exit statuses
_PACKAGE = Path(__file__).parent


def run_command(name: str, command: Callable[[], int | None], *, debug: bool = False) -> int:
    """The exit status of a command: its own, or that of its failure, which is told on stderr in one line.

    Args:
        name: What the lines begin with.
        command: Returns its exit status, None for 0.
        debug: Errors are raised instead.
    """

    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"{name}: warning: {one_line(message)}", file=sys.stderr)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            return command() or 0
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if debug:
            raise
        print(f"{name}: error: {_told(error)}", file=sys.stderr)
        return WRONG


def one_line(message: object) -> str:
    """A message without its line breaks."""
    return " ".join(str(message).split())


def _told(error: Exception) -> str:
    """An error in one line; one that nothing foresaw with its kind, and the step of the package that it came from."""
    if isinstance(error, (ValueError, OSError)) and not isinstance(error, UnicodeError):
        return one_line(error)
    where = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)[1:]]
    steps = [path.relative_to(_PACKAGE).with_suffix("") for path in where if path.is_relative_to(_PACKAGE)]
    step = f" in {'.'.join(steps[-1].parts)}" if steps else ""
    memory = isinstance(error, MemoryError) or "not enough memory" in str(error)
    what = "out of memory" if memory else f"{type(error).__name__}: {one_line(error)[:200]}"
    return f"{what}{step} (--debug shows the traceback)"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table.

    >>> print(markdown_table(["plate", "mm"], [["femoral", "0.03"]]))
    | plate | mm |
    | --- | --- |
    | femoral | 0.03 |
    """
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows])

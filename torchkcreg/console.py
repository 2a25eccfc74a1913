"""Console output of the commands: results, one-line warnings and errors, and tables."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import logging
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .plain import plain
from .progress import silence

WRONG, INTERRUPTED = 2, 130  # exit statuses
_PACKAGE = Path(__file__).parent


@dataclass(frozen=True)
class Answer:
    """Result of a command.

    Attributes:
        text: Result for people.
        data: The same for programs, as plain data by name.
        status: Exit status.
    """

    text: str
    data: dict[str, Any] = field(default_factory=dict)
    status: int = 0


@dataclass(frozen=True)
class Voice:
    """Amount and format of a command's output.

    Attributes:
        quiet: Print only warnings and errors.
        verbose: Log each step with the elapsed time.
        json: Print one JSON object with the result and the warnings on stdout, and everything else on stderr.
        debug: Raise errors with their traceback.
    """

    quiet: bool = False
    verbose: bool = False
    json: bool = False
    debug: bool = False


def run_command(name: str, command: Callable[[], Answer | None], voice: Voice = Voice()) -> int:
    """Run a command, print its result, and return its exit status. An error is printed on stderr in one line.

    Args:
        name: Name of the command, printed before each warning and error.
        command: Function that runs the command and returns its result.
        voice: Amount and format of the output.
    """
    warnings_shown: list[str] = []

    def show(message: Warning | str, *_: object, **__: object) -> None:
        warnings_shown.append(one_line(message))
        print(f"{name}: warning: {warnings_shown[-1]}", file=sys.stderr)

    try:
        with warnings.catch_warnings(), _spoken(name, voice):
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            answer = command() or Answer("")
        if voice.json:
            print(json.dumps(plain({**answer.data, "warnings": warnings_shown}), allow_nan=False))
        elif answer.text and not voice.quiet:
            print(answer.text)
        return answer.status
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if voice.debug:
            raise
        print(f"{name}: error: {_told(error)}", file=sys.stderr)
        return WRONG


@contextlib.contextmanager
def _spoken(name: str, voice: Voice) -> Iterator[None]:
    """Silence progress bars, redirect printed text and log steps, as `voice` asks."""
    silence(voice.quiet)
    log, handler, start = logging.getLogger("torchkcreg"), logging.StreamHandler(), time.perf_counter()
    handler.format = lambda record: f"{name}: {time.perf_counter() - start:7.1f} s  {record.getMessage()}"  # type: ignore[method-assign]
    level = log.level
    if voice.verbose:
        log.addHandler(handler)
        log.setLevel(logging.INFO)
    aside = sys.stderr if voice.json else io.StringIO()
    try:
        with contextlib.redirect_stdout(aside) if voice.json or voice.quiet else contextlib.nullcontext():
            yield
        log.info("done")
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        silence(False)


def one_line(message: object) -> str:
    """A message without its line breaks."""
    return " ".join(str(message).split())


def _told(error: Exception) -> str:
    """Error message in one line. Unexpected errors also name their type and the module they came from."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None and error.strerror:
        return one_line(error.strerror)
    if isinstance(error, (ValueError, OSError)) and not isinstance(error, UnicodeError):
        return one_line(error)
    files = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)[1:]]
    steps = [path.relative_to(_PACKAGE).with_suffix("") for path in files if path.is_relative_to(_PACKAGE)]
    step = f" in {'.'.join(steps[-1].parts)}" if steps else ""
    memory = isinstance(error, MemoryError) or "not enough memory" in str(error)
    problem = "out of memory" if memory else f"{type(error).__name__}: {one_line(error)[:200]}"
    return f"{problem}{step} (--debug shows the traceback)"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table.

    >>> print(markdown_table(["plate", "mm"], [["femoral", "0.03"]]))
    | plate | mm |
    | --- | --- |
    | femoral | 0.03 |
    """
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows])

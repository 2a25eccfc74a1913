"""Text, JSON and figure files: reading with errors that name the file, atomic writing; size of the memory."""

from __future__ import annotations

import codecs
import errno
import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchkcreg.plain import plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROOM = 1 << 16  # bytes; with less than that a disk is full
TEMPORARY_PREFIX = ".writing-"


def existing_file(path: str | os.PathLike[str], what: str) -> Path:
    """The path of an existing regular file.

    Args:
        path: Path of the file.
        what: Kind of file, for the error message ("geometry", "mesh", ...).

    Raises:
        FileNotFoundError: The path does not exist.
        ValueError: The path is a folder or another thing that is not a regular file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{what} file {path} does not exist")
    if not path.is_file():
        raise ValueError(f"{what} file {path} is not a file")
    return path


def existing_place(path: str | os.PathLike[str], what: str) -> Path:
    """The path of an existing file or folder. Raises the same errors as `existing_file`."""
    return Path(path) if Path(path).is_dir() else existing_file(path, what)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`: renamed to `path` when the block succeeds, deleted when it fails.

    The temporary name keeps the suffix, since many writers choose the format by it.

    Raises:
        OSError: The disk is full; the message says so, whatever the writer raised.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "answer.txt") as temporary:
    ...     _ = temporary.write_text("42")
    >>> [entry.name for entry in folder.iterdir()]
    ['answer.txt']
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"folder {path.parent} does not exist, so {path.name} cannot be written there")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, not a file to write")
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    except Exception as error:
        if _is_full(path.parent, error):
            advice = "make room, then run it again (register and reconstruct continue with --resume)"
            raise OSError(errno.ENOSPC, f"the disk is full, {path} was not written: {advice}") from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _is_full(folder: Path, error: Exception) -> bool:
    """True if writing into a folder failed for want of room; some writers raise errors that do not say so."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    return shutil.disk_usage(folder).free < _ROOM


def physical_memory() -> float:
    """Physical memory of the machine in bytes; infinite if the system does not report it."""
    names = getattr(os, "sysconf_names", {})
    if not {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= set(names):
        return math.inf
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def append_line(path: str | os.PathLike[str], line: str) -> None:
    """Append a line to a text file. The file and its folder are created if missing."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")


def read_text(path: str | os.PathLike[str], what: str) -> str:
    """The text of a UTF-8 file, or of a UTF-16 file with a byte order mark.

    Line ends are converted to newlines.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a text file.
    """
    path = existing_file(path, what)
    content = path.read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{what} file {path} is not a text file (UTF-8): {error.reason}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | os.PathLike[str], what: str) -> Any:
    """The content of a JSON file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not valid JSON; the message names the file and the line.
    """
    text = read_text(path, what)
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{what} file {path} is not valid JSON: {error}") from error


def write_json(path: str | os.PathLike[str], content: Any, *, indent: int | None = 1) -> None:
    """Write `content` as strict JSON, atomically. See `plain` for the supported types."""
    write_text(path, json.dumps(plain(content), indent=indent, allow_nan=False) + "\n")


def write_figure(path: str | os.PathLike[str], figure: Figure, *, dpi: int = 150) -> None:
    """Write a matplotlib figure atomically, in the format of the suffix (.png, .pdf, .svg)."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)

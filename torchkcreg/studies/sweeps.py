"""Many runs of one function, in parallel, each finished one kept: what was broken off goes on where it stopped."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from torchkcreg.io.files import append_line, read_text, write_text
from torchkcreg.plain import plain
from torchkcreg.progress import progress_bar

Job = dict[str, Any]
Row = dict[str, Any]

_SECONDS = 10  # to find a cluster


def sweep(
    function: Callable[[Job], Row],
    jobs: Sequence[Job],
    table: Path,
    *,
    workers: int = 2,
    cluster: str | None = None,
    on_row: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Rows of all jobs, in their order; those that the table already holds are not run again.

    A job that fails with a ValueError or RuntimeError has a row with its `error` alone, and is tried again when the
    sweep is started again. Rows come to the table as they are made, so that a killed sweep loses no finished one.

    Args:
        function: Of a module, so that other processes find it; what it gives is written as JSON.
        jobs: Its arguments, plain types; two alike are one.
        table: File of JSON lines, each a job and its row; it is made.
        workers: Processes on this machine, a thread each. One runs here.
        cluster: Address of a Dask scheduler whose workers run the jobs in their place.
        on_row: Hears each row that is made.

    Raises:
        ValueError: If more than one worker, or a cluster, is asked for and joblib or Dask is not installed; if the
            table is no such file.
    """
    kept, version = read_table(table), importlib.metadata.version("torchkcreg")
    left = [job for key, job in {_key(job): job for job in jobs}.items() if "error" in kept.get(key, {"error": ""})]
    rows = _made(function, left, workers, cluster)
    for job, row in progress_bar(rows, total=len(left), desc=table.stem, shown=True):
        kept[_key(job)] = plain(row)
        append_line(table, json.dumps({"job": job, "row": plain(row), "version": version}))
        on_row(row)
    return [kept[_key(job)] for job in jobs]


def read_table(table: Path) -> dict[str, Row]:
    """Rows of a sweep's table by their job; the last line, where it was broken off, is left out.

    Raises:
        ValueError: If another line is malformed.
    """
    lines = read_text(table, "table").splitlines() if table.exists() else []
    found, versions = {}, set[str]()
    for number, line in enumerate(lines, start=1):
        entry = _entry(line)
        if entry is None and number == len(lines):
            write_text(table, "".join(f"{kept}\n" for kept in lines[:-1]))
        elif entry is None:
            raise ValueError(f"table {table}, line {number} is no job with its row: {line[:80]}")
        else:
            found[_key(entry["job"])] = entry["row"]
            versions.add(str(entry["version"]))
    if others := sorted(versions - {importlib.metadata.version("torchkcreg")}):
        warnings.warn(f"table {table} has rows that torchkcreg {', '.join(others)} made", stacklevel=3)
    return found


def _entry(line: str) -> dict[str, Any] | None:
    """A job with its row and the version that made it; None where a line holds none."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    kinds = {"job": dict, "row": dict, "version": str}
    whole = isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())
    return entry if whole else None


def _key(job: Job) -> str:
    return json.dumps(job, sort_keys=True)


def _made(
    function: Callable[[Job], Row], jobs: Sequence[Job], workers: int, cluster: str | None
) -> Iterator[tuple[Job, Row]]:
    """Jobs and their rows as they are made."""
    if workers == 1 and cluster is None:
        yield from (_one(function, job) for job in jobs)
        return
    if cluster is None:
        joblib = _installed("joblib", "several workers")
        calls = [joblib.delayed(_on_one_thread)(function, job) for job in jobs]
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            yield from joblib.Parallel(n_jobs=workers, return_as="generator_unordered")(calls)
        return
    distributed = _installed("distributed", "a Dask cluster")
    try:
        client = distributed.Client(cluster, timeout=_SECONDS)
    except (OSError, ValueError) as error:  # a timeout is an OSError
        raise ValueError(f"no Dask scheduler answers at {cluster}: {error}") from None
    with client:
        futures = client.map(_on_one_thread, [function] * len(jobs), jobs, pure=False)
        for future in distributed.as_completed(futures):
            yield future.result()


def _installed(package: str, asked: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError:
        raise ValueError(f"{asked} needs {package}: pip install 'torchkcreg[studies]'") from None


def _on_one_thread(function: Callable[[Job], Row], job: Job) -> tuple[Job, Row]:
    torch.set_num_threads(1)
    return _one(function, job)


def _one(function: Callable[[Job], Row], job: Job) -> tuple[Job, Row]:
    try:
        return job, function(job)
    except (ValueError, RuntimeError) as error:
        return job, {"error": f"{type(error).__name__}: {error}"}

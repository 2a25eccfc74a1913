"""Run one function on many jobs in parallel. Finished jobs are saved, so that a stopped sweep can be continued."""

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

_SECONDS = 10  # timeout for connecting to a cluster


def sweep(
    function: Callable[[Job], Row],
    jobs: Sequence[Job],
    table: Path,
    *,
    workers: int = 2,
    cluster: str | None = None,
    on_row: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run all jobs and return their rows in the order of the jobs. Jobs already in the table are not run again.

    The row of a job that fails with a ValueError or RuntimeError holds only its `error`, and the job is run again when
    the sweep is restarted. Each row is written to the table at once, so a killed sweep loses no finished job.

    Args:
        function: Function defined in a module, so that other processes can import it. Its row is written as JSON.
        jobs: Arguments of the function, plain types. Identical jobs are run once.
        table: File of JSON lines, each a job and its row; created if missing.
        workers: Number of processes on this machine, with one thread each. A single worker is this process itself.
        cluster: Address of a Dask scheduler whose workers run the jobs instead.
        on_row: Called with each new row.

    Raises:
        ValueError: If more than one worker or a cluster needs joblib or Dask, which is not installed, or the table is
            not a file written by `sweep`.
    """
    rows_by_job, version = read_table(table), importlib.metadata.version("torchkcreg")
    remaining = [
        job for key, job in {_key(job): job for job in jobs}.items() if "error" in rows_by_job.get(key, {"error": ""})
    ]
    rows = _made(function, remaining, workers, cluster)
    for job, row in progress_bar(rows, total=len(remaining), desc=table.stem, shown=True):
        rows_by_job[_key(job)] = plain(row)
        append_line(table, json.dumps({"job": job, "row": plain(row), "version": version}))
        on_row(row)
    return [rows_by_job[_key(job)] for job in jobs]


def read_table(table: Path) -> dict[str, Row]:
    """Rows of a sweep's table, by job. A last line that is incomplete is removed from the file.

    Raises:
        ValueError: If any other line is malformed.
    """
    lines = read_text(table, "table").splitlines() if table.exists() else []
    rows, versions = {}, set[str]()
    for number, line in enumerate(lines, start=1):
        entry = _entry(line)
        if entry is None and number == len(lines):
            write_text(table, "".join(f"{complete}\n" for complete in lines[:-1]))
        elif entry is None:
            raise ValueError(f"table {table}, line {number} is no job with its row: {line[:80]}")
        else:
            rows[_key(entry["job"])] = entry["row"]
            versions.add(str(entry["version"]))
    if other_versions := sorted(versions - {importlib.metadata.version("torchkcreg")}):
        warnings.warn(f"table {table} has rows that torchkcreg {', '.join(other_versions)} made", stacklevel=3)
    return rows


def _entry(line: str) -> dict[str, Any] | None:
    """Job, row and version from a line of the table; None if the line is malformed."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    kinds = {"job": dict, "row": dict, "version": str}
    is_valid = isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())
    return entry if is_valid else None


def _key(job: Job) -> str:
    return json.dumps(job, sort_keys=True)


def _made(
    function: Callable[[Job], Row], jobs: Sequence[Job], workers: int, cluster: str | None
) -> Iterator[tuple[Job, Row]]:
    """Yield each job with its row as soon as it is finished."""
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


def _installed(package: str, purpose: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError:
        raise ValueError(f"{purpose} needs {package}: pip install 'torchkcreg[studies]'") from None


def _on_one_thread(function: Callable[[Job], Row], job: Job) -> tuple[Job, Row]:
    torch.set_num_threads(1)
    return _one(function, job)


def _one(function: Callable[[Job], Row], job: Job) -> tuple[Job, Row]:
    try:
        return job, function(job)
    except (ValueError, RuntimeError) as error:
        return job, {"error": f"{type(error).__name__}: {error}"}

"""Helpers for all benchmarks: name of the processor, installed peer libraries, timing in interleaved rounds."""

from __future__ import annotations

import csv
import importlib.util
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_SLOW = 5.0


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def installed(module: str) -> bool:
    """True if a module is installed. Does not import it."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def present(modules: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Names of the libraries that are installed and of those that are not; prints a line for each of the latter."""
    left_out = [name for name, module in modules.items() if not installed(module)]
    for name in left_out:
        print(f"{name} is not installed and is left out")
    return [name for name in modules if name not in left_out], left_out


def timed(steps: Mapping[Any, Callable[[], Any]], rounds: int) -> tuple[dict[Any, float], dict[Any, Any]]:
    """Best time of each step in seconds over some rounds after a warm-up, and the results of the warm-up.

    In each round all steps run in turn. A step that takes more than `_SLOW` seconds runs in one round only, after its
    warm-up, in which libraries compile and allocate.
    """
    best, results = {}, {}
    for key, run in steps.items():
        start = time.perf_counter()
        results[key] = run()
        best[key] = time.perf_counter() - start
    slow = {key for key, seconds in best.items() if seconds > _SLOW}
    best = dict.fromkeys(best, float("inf"))
    for number in range(rounds):
        for key, run in steps.items():
            if number == 0 or key not in slow:
                start = time.perf_counter()
                run()
                best[key] = min(best[key], time.perf_counter() - start)
    return best, results


def write_report(path: Path, text: str) -> None:
    """Write a Markdown report, and each of its tables as CSV beside it: name.csv, name-2.csv, ..."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    tables: list[list[list[str]]] = [[]]
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            tables[-1].append([cell.strip() for cell in line.strip("|").split("|")])
        elif tables[-1]:
            tables.append([])
    for number, (header, _, *rows) in enumerate(tables[:-1], start=1):
        name = path.stem if number == 1 else f"{path.stem}-{number}"
        with path.with_name(f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([header, *rows])

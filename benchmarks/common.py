"""What the benchmarks share: the machine's name, which peers are there, rounds in turns."""

from __future__ import annotations

import importlib.util
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_SLOW = 5.0


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def present(modules: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Names of libraries whose modules are installed, and of those that are left out, with a word."""
    left_out = [name for name, module in modules.items() if not installed(module)]
    for name in left_out:
        print(f"{name} is not installed and left out")
    return [name for name in modules if name not in left_out], left_out


def timed(steps: Mapping[Any, Callable[[], Any]], rounds: int) -> tuple[dict[Any, float], dict[Any, Any]]:
    """Seconds of the best of some rounds, in which all steps take turns, after one to warm up; what that one gave.

    What takes more than `_SLOW` seconds is called once alone: warming up is nothing against that.
    """
    best, results = {}, {}
    for key, run in steps.items():
        start = time.perf_counter()
        results[key] = run()
        best[key] = time.perf_counter() - start
    quick = {key: run for key, run in steps.items() if best[key] < _SLOW}
    best |= dict.fromkeys(quick, float("inf"))
    for _ in range(rounds):
        for key, run in quick.items():
            start = time.perf_counter()
            run()
            best[key] = min(best[key], time.perf_counter() - start)
    return best, results

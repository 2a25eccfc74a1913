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


def best_times(steps: Mapping[Any, Callable[[], Any]], rounds: int) -> dict[Any, float]:
    """Seconds of the best of some rounds, in which all steps take turns, after one to warm up.

    What takes more than `_SLOW` seconds is called once alone: warming up is nothing against that.
    """
    best = {key: _seconds(run) for key, run in steps.items()}
    quick = {key: run for key, run in steps.items() if best[key] < _SLOW}
    best |= dict.fromkeys(quick, float("inf"))
    for _ in range(rounds):
        for key, run in quick.items():
            best[key] = min(best[key], _seconds(run))
    return best


def _seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start

"""`torchkcreg demo`: simulate, register and evaluate a loaded plate."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_demo(commands) -> None:
    """Add the flags of `torchkcreg demo`."""
    command = add_command(commands, "demo", _demo, "simulate a loaded plate, register it, evaluate and draw the result")
    command.add_argument("--out", type=Path, default=Path("demo"), help="output folder (default: demo)")
    command.add_argument("--seed", type=int, default=0, help="seed of the simulated noise")
    command.add_argument("--overwrite", action="store_true", help="replace an existing demo in the folder")


def _demo(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import demo

    demo(options.out, seed=options.seed, overwrite=options.overwrite)
    return Answer("", {"folder": options.out})

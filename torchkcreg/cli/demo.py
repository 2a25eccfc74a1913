"""The command `torchkcreg demo`."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_demo(commands) -> None:
    command = add_command(commands, "demo", _demo, "simulate a loaded plate, register it, evaluate and draw the result")
    command.add_argument("--out", type=Path, default=Path("demo"), help="folder to make")
    command.add_argument("--seed", type=int, default=0, help="seed of the simulated noise")
    command.add_argument("--overwrite", action="store_true", help="replace the demo that the folder holds")


def _demo(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import demo

    demo(options.out, seed=options.seed, overwrite=options.overwrite)
    return Answer("", {"folder": options.out})

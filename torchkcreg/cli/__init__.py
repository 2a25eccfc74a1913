"""The command line: `torchkcreg assess | register | warp | evaluate | compare | load | reconstruct | ...`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import NoReturn

import torchkcreg
from torchkcreg.console import one_line, run_command

from .assess import add_assess
from .command import voice_of
from .compare import add_compare
from .completion import add_completion
from .convert import add_convert
from .demo import add_demo
from .densitometry import add_densitometry
from .doctor import add_doctor
from .evaluate import add_evaluate
from .experiment import add_experiment
from .follow import add_follow
from .info import add_info
from .load import add_load
from .plan import add_plan
from .reconstruct import add_reconstruct
from .register import add_register
from .report import add_report
from .simulate import add_simulate
from .study import add_study
from .warp import add_warp

# Must be set before torch starts its threads: idle threads then spin for a few microseconds before they sleep. If they
# sleep at once, a registration takes twice as long; if they spin for long, they slow down when other programs run.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0: success. 2: an error, reported in one line. 3: a registration failed; its run folder is written, but the result
    must not be used.
    """
    try:
        options = _parser().parse_args(arguments)
    except SystemExit as done:  # argparse exits after --help, --version, or a wrong flag
        return int(done.code or 0)
    return run_command(f"torchkcreg {options.command}", lambda: options.run(options), voice_of(options))


class _Parser(argparse.ArgumentParser):
    """An argument parser that reports errors in one line, like all other errors."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {one_line(message)}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchkcreg", description=torchkcreg.__doc__)
    parser.add_argument("--version", action="version", version=f"torchkcreg {torchkcreg.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_assess(commands)
    add_follow(commands)
    add_register(commands)
    add_warp(commands)
    add_evaluate(commands)
    add_load(commands)
    add_densitometry(commands)
    add_compare(commands)
    add_report(commands)
    add_convert(commands)
    add_plan(commands)
    add_simulate(commands)
    add_experiment(commands)
    add_study(commands)
    add_reconstruct(commands)
    add_info(commands)
    add_doctor(commands)
    add_completion(commands, _parser)
    add_demo(commands)
    return parser

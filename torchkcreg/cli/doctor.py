"""`torchkcreg doctor`: check of the installation."""

from __future__ import annotations

import argparse

from torchkcreg.console import Answer

from .command import add_command

UNHEALTHY = 1


def add_doctor(commands) -> None:
    """Add the flags of `torchkcreg doctor`."""
    text = "check the installation: versions, compiled kernels, threads, and a self-test of a few seconds"
    add_command(commands, "doctor", _doctor, text)


def _doctor(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import doctor

    text, healthy = doctor()
    return Answer(text, {"healthy": healthy, "lines": text.splitlines()}, 0 if healthy else UNHEALTHY)

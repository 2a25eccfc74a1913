"""``torchkcreg doctor``: whether the installation works."""

from __future__ import annotations

import argparse

from torchkcreg.console import Answer

from .command import add_command

UNHEALTHY = 1


def add_doctor(commands) -> None:
    """Adds the command."""
    text = "look whether the installation works: versions, kernels, threads, and a self-test of some seconds"
    add_command(commands, "doctor", _doctor, text)


def _doctor(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import doctor

    text, healthy = doctor()
    return Answer(text, {"healthy": healthy, "lines": text.splitlines()}, 0 if healthy else UNHEALTHY)

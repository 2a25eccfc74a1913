"""``torchkcreg doctor``: whether the installation works."""

from __future__ import annotations

import argparse

from .command import add_command

UNHEALTHY = 1


def add_doctor(commands) -> None:
    """Adds the command."""
    text = "look whether the installation works: versions, kernels, threads, and a self-test of some seconds"
    add_command(commands, "doctor", _doctor, text)


def _doctor(options: argparse.Namespace) -> int:
    from torchkcreg.experiments import doctor

    text, healthy = doctor()
    print(text)
    return 0 if healthy else UNHEALTHY

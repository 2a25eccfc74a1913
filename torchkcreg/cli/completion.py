"""``torchkcreg completion``: what a shell needs to complete commands and flags."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from torchkcreg.console import Answer

from .command import add_command


def add_completion(commands, parser: Callable[[], argparse.ArgumentParser]) -> None:
    """Adds the command.

    Args:
        commands: Where to.
        parser: Makes the whole parser, of which the commands are completed.
    """
    text = "print what a shell needs to complete commands and flags (extra completion)"
    command = add_command(commands, "completion", lambda options: _completion(options, parser), text)
    where = "for bash: torchkcreg completion bash > ~/.local/share/bash-completion/completions/torchkcreg"
    command.add_argument("shell", choices=("bash", "zsh", "tcsh"), help=where)


def _completion(options: argparse.Namespace, parser: Callable[[], argparse.ArgumentParser]) -> Answer:
    try:
        import shtab
    except ImportError:
        raise ImportError("completion needs shtab: pip install 'torchkcreg[completion]'") from None
    script = shtab.complete(parser(), options.shell)
    return Answer(script, {"script": script})

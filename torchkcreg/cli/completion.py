"""`torchkcreg completion`: shell completion of commands and flags."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from torchkcreg.console import Answer

from .command import add_command


def add_completion(commands, parser: Callable[[], argparse.ArgumentParser]) -> None:
    """Add the flags of `torchkcreg completion`.

    Args:
        commands: Subparsers of the main parser.
        parser: Builds the main parser, whose commands and flags are completed.
    """
    text = "print a script for shell completion of commands and flags (needs torchkcreg[completion])"
    command = add_command(commands, "completion", lambda options: _completion(options, parser), text)
    usage = "for bash: torchkcreg completion bash > ~/.local/share/bash-completion/completions/torchkcreg"
    command.add_argument("shell", choices=("bash", "zsh", "tcsh"), help=usage)


def _completion(options: argparse.Namespace, parser: Callable[[], argparse.ArgumentParser]) -> Answer:
    try:
        import shtab
    except ImportError:
        raise ImportError("completion needs shtab: pip install 'torchkcreg[completion]'") from None
    script = shtab.complete(parser(), options.shell)
    return Answer(script, {"script": script})

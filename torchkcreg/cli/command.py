"""Flags that all commands share."""

from __future__ import annotations

import argparse

from torchkcreg.console import Voice

FAILED = 3  # exit status of a registration that failed


def add_command(commands, name: str, run, text: str) -> argparse.ArgumentParser:
    """Add a command with the shared flags, and return its parser.

    Args:
        commands: Subparsers of the main parser.
        name: Name of the command.
        run: Function that is called with the parsed options and returns an `Answer`.
        text: Help text, lower case, without a period.
    """
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.set_defaults(run=run)
    voice = command.add_argument_group("output")
    voice.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    voice.add_argument("--verbose", action="store_true", help="print each step with its time on stderr")
    voice.add_argument("--json", action="store_true", help="print the result as one JSON object on stdout")
    voice.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return command


def voice_of(options: argparse.Namespace) -> Voice:
    """Verbosity and output format, from the parsed options."""
    return Voice(options.quiet, options.verbose, options.json, options.debug)

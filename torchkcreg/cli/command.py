"""What all commands have in common."""

from __future__ import annotations

import argparse

from torchkcreg.console import Voice


def add_command(commands, name: str, run, text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.set_defaults(run=run)
    voice = command.add_argument_group("what is said")
    voice.add_argument("--quiet", action="store_true", help="warnings and errors alone")
    voice.add_argument("--verbose", action="store_true", help="each step and when it came, on stderr")
    voice.add_argument("--json", action="store_true", help="what was found as one JSON object on stdout")
    voice.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return command


def voice_of(options: argparse.Namespace) -> Voice:
    """How much the command says."""
    return Voice(options.quiet, options.verbose, options.json, options.debug)

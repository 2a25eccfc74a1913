"""The command `torchkcreg info`."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_info(commands) -> None:
    command = add_command(commands, "info", _info, "say what a file or a run folder holds, or what is installed")
    command.add_argument("paths", type=Path, nargs="*", help="meshes, geometries, projections, run folders")
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, where projections do not say it")
    drawn = "figure to write of a geometry: focal spots and detectors in three dimensions (PNG, PDF, SVG)"
    command.add_argument("--picture", type=Path, help=drawn)


def _info(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import describe, describe_installation, picture_geometry, runs_compared

    if options.picture is not None:
        picture_geometry(options.paths, options.picture)
    told = {str(path): describe(path, open_beam=options.open_beam) for path in options.paths}
    texts = list(told.values()) or [describe_installation()]
    if compared := runs_compared(options.paths):
        texts.append(compared)
    return Answer("\n".join(texts), {"files": told} if told else {"installation": texts[0].splitlines()})

"""`torchkcreg info`: describe files, run folders or the installation."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_info(commands) -> None:
    """Add the flags of `torchkcreg info`."""
    command = add_command(commands, "info", _info, "describe files and run folders; without paths, the installation")
    command.add_argument("paths", type=Path, nargs="*", help="meshes, geometries, projections, run folders, ...")
    command.add_argument(
        "--open-beam", type=float, help="unattenuated intensity of projections, if their file does not give it"
    )
    picture = "write a 3D figure of a geometry's focal spots and detectors (PNG, PDF, SVG)"
    command.add_argument("--picture", type=Path, help=picture)


def _info(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import describe, describe_installation, picture_geometry, runs_compared

    if options.picture is not None:
        picture_geometry(options.paths, options.picture)
    descriptions = {str(path): describe(path, open_beam=options.open_beam) for path in options.paths}
    texts = list(descriptions.values()) or [describe_installation()]
    if compared := runs_compared(options.paths):
        texts.append(compared)
    return Answer(
        "\n".join(texts), {"files": descriptions} if descriptions else {"installation": texts[0].splitlines()}
    )

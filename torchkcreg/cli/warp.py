"""`torchkcreg warp`: map points from the undeformed implant's frame to the world."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_warp(commands) -> None:
    """Add the flags of `torchkcreg warp`."""
    command = add_command(commands, "warp", _warp, "map points from the undeformed implant's frame to the world")
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, required=True, help="x,y,z in the implant's frame, mm (CSV)")
    command.add_argument(
        "--out", type=Path, required=True, help="CSV file to write: x,y,z in the world, outside flag, expected errors"
    )
    command.add_argument(
        "--implant-name", help="which implant the points belong to, if the run has several (name of its mesh file)"
    )
    command.add_argument(
        "--overwrite", action="store_true", help="replace any file; without it only a table of warped points"
    )


def _warp(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import warp_files

    outside = warp_files(
        options.run_folder,
        options.points,
        options.out,
        implant_name=options.implant_name,
        overwrite=options.overwrite,
    )
    return Answer("", {"out": options.out, "points": len(outside), "outside": int(outside.sum())})

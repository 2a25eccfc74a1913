"""The command `torchkcreg warp`."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_warp(commands) -> None:
    command = add_command(commands, "warp", _warp, "move points of the undeformed implant's frame to the world")
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, required=True, help="x,y,z in the implant's frame, mm (CSV)")
    command.add_argument(
        "--out", type=Path, required=True, help="CSV to write: x,y,z in the world, outside or not, deviations"
    )
    command.add_argument("--implant-name", help="of several implants, the one whose frame the points are in (its file)")


def _warp(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import warp_files

    outside = warp_files(options.run_folder, options.points, options.out, implant_name=options.implant_name)
    return Answer("", {"out": options.out, "points": len(outside), "outside": int(outside.sum())})

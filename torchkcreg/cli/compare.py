"""`torchkcreg compare`: motion of a fracture's fragments between registrations."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_compare(commands) -> None:
    """Add the flags of `torchkcreg compare`."""
    text = "measure how a fracture's fragments move relative to each other under load, with error bars"
    command = add_command(commands, "compare", _compare, text)
    command.add_argument(
        "unloaded", type=Path, metavar="RUN_UNLOADED", help="run folder of the registration without load"
    )
    command.add_argument(
        "loaded", type=Path, nargs="+", metavar="RUN_LOADED", help="run folders of the registrations under load"
    )
    command.add_argument(
        "--loads", type=float, nargs="+", default=(), metavar="N", help="load of each RUN_LOADED, in newtons"
    )
    plane = "fracture plane in the implant's frame: point, or point and normal (default: from the screws)"
    command.add_argument("--plane", type=float, nargs="+", metavar="MM", help=plane)
    command.add_argument(
        "--fragment", type=Path, help="surface mesh of one fragment: screws in it belong to this fragment (STL, ...)"
    )
    command.add_argument("--out", type=Path, help="output folder (default: compare in the first RUN_LOADED)")
    command.add_argument("--implant-name", help="which implant, if the run has several (name of its mesh file)")
    command.add_argument("--no-figures", action="store_true", help="do not draw the figure")


def _compare(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import compare_files

    comparison = compare_files(
        options.unloaded,
        options.loaded,
        options.out or options.loaded[0] / "compare",
        loads=options.loads,
        plane=options.plane,
        fragment=options.fragment,
        name=options.implant_name,
        figures=not options.no_figures,
    )
    return Answer(str(comparison), comparison.to_dict())

"""``torchkcreg compare``: how the fragments of a fracture moved between registrations."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_compare(commands) -> None:
    """Adds the command."""
    text = "say how one fragment moved against the other from an unloaded registration to loaded ones, with error bars"
    command = add_command(commands, "compare", _compare, text)
    command.add_argument("unloaded", type=Path, metavar="RUN_UNLOADED", help="folder of the first registration")
    command.add_argument("loaded", type=Path, nargs="+", metavar="RUN_LOADED", help="folders of the others")
    command.add_argument("--loads", type=float, nargs="+", default=(), metavar="N", help="in newtons, one a loaded run")
    where = "where the fracture is, in the implant's frame: a point, or a point and a normal (default: the screws tell)"
    command.add_argument("--plane", type=float, nargs="+", metavar="MM", help=where)
    command.add_argument("--fragment", type=Path, help="surface of one fragment, which tells its screws (STL, ...)")
    command.add_argument("--out", type=Path, help="folder for table and figure (default: first RUN_LOADED/compare)")
    command.add_argument("--implant-name", help="of several implants, which (its file)")
    command.add_argument("--no-figures", action="store_true", help="leave the picture out")


def _compare(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import compare_files

    found = compare_files(
        options.unloaded,
        options.loaded,
        options.out or options.loaded[0] / "compare",
        loads=options.loads,
        plane=options.plane,
        fragment=options.fragment,
        name=options.implant_name,
        figures=not options.no_figures,
    )
    return Answer(str(found), found.to_dict())

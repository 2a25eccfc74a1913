"""``torchkcreg load``: what the implant of a registration carries."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_load(commands) -> None:
    """Adds the command."""
    text = "say what the implant carries: moments along it, loads at its holes, stresses (runs of --deformation fe)"
    command = add_command(commands, "load", _load, text)
    command.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a finished registration")
    unloaded = "registration of the same implant without load: what both have in common is no load"
    command.add_argument("--against", type=Path, metavar="RUN_UNLOADED", help=unloaded)
    command.add_argument("--out", type=Path, help="folder for load.json, load.vtu and load.png (default: RUN/load)")
    command.add_argument("--implant", type=Path, help="undeformed mesh (default: the one that the run names)")
    command.add_argument("--implant-name", help="of several implants, which (its file)")
    command.add_argument("--no-figures", action="store_true", help="leave the picture out")


def _load(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import load_files

    found = load_files(
        options.run_folder,
        options.out or options.run_folder / "load",
        against=options.against,
        implant=options.implant,
        name=options.implant_name,
        figures=not options.no_figures,
    )
    return Answer(str(found), found.to_dict())

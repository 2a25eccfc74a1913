"""`torchkcreg load`: loads and stresses of a registered implant."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_load(commands) -> None:
    """Add the flags of `torchkcreg load`."""
    text = "estimate an implant's loads: moments along it, loads at its holes, stresses (run with --deformation fe)"
    command = add_command(commands, "load", _load, text)
    command.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a finished registration")
    unloaded = "run folder of the same implant without load: its deformation is subtracted"
    command.add_argument("--against", type=Path, metavar="RUN_UNLOADED", help=unloaded)
    command.add_argument(
        "--out", type=Path, help="output folder for load.json, load.vtu and load.png (default: RUN/load)"
    )
    command.add_argument("--implant", type=Path, help="mesh of the undeformed implant (default: the mesh of the run)")
    command.add_argument("--implant-name", help="which implant, if the run has several (name of its mesh file)")
    command.add_argument("--no-figures", action="store_true", help="do not draw the figure")


def _load(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import load_files

    load = load_files(
        options.run_folder,
        options.out or options.run_folder / "load",
        against=options.against,
        implant=options.implant,
        name=options.implant_name,
        figures=not options.no_figures,
    )
    return Answer(str(load), load.to_dict())

"""``torchkcreg simulate``: a case out of a recipe."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_simulate(commands) -> None:
    """Adds the command."""
    text = "make projections of an implant under load, with the truth about them, out of a recipe (YAML)"
    command = add_command(commands, "simulate", _simulate, text)
    command.add_argument("recipe", type=Path, help="implant, screws, limb, loads, tube, detector, views")
    command.add_argument("--out", type=Path, default=Path("case"), help="folder to make (default: case)")
    command.add_argument("--overwrite", action="store_true", help="replace a case of another recipe")
    command.add_argument("--no-figures", action="store_true", help="leave the pictures out")


def _simulate(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import simulate_files

    found = simulate_files(options.recipe, options.out, overwrite=options.overwrite, figures=not options.no_figures)
    return Answer(str(found), vars(found))

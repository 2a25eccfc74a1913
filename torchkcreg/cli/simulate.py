"""`torchkcreg simulate`: simulated projections from a recipe."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_simulate(commands) -> None:
    """Add the flags of `torchkcreg simulate`."""
    text = "simulate projections of an implant under load from a recipe (YAML), with the ground truth"
    command = add_command(commands, "simulate", _simulate, text)
    command.add_argument("recipe", type=Path, help="YAML file: implant, screws, limb, loads, tube, detector, views")
    command.add_argument("--out", type=Path, default=Path("case"), help="output folder (default: case)")
    command.add_argument("--overwrite", action="store_true", help="replace a case that was made from another recipe")
    command.add_argument("--no-figures", action="store_true", help="do not draw figures")


def _simulate(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import simulate_files

    case = simulate_files(options.recipe, options.out, overwrite=options.overwrite, figures=not options.no_figures)
    return Answer(str(case), vars(case))

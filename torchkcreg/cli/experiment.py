"""`torchkcreg experiment`: the paper's two experiments."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_experiment(commands) -> None:
    """Add the flags of `torchkcreg experiment`."""
    text = "simulate, register and evaluate one of the paper's two experiments; finished parts in the folder are kept"
    command = add_command(commands, "experiment", _experiment, text)
    names = ("tibial-plate", "femoral-plate")
    command.add_argument("name", choices=names, metavar="NAME", help=" or ".join(names))
    command.add_argument("--quick", action="store_true", help="few loads and views, coarse pixels: a few minutes")
    command.add_argument("--blind", action="store_true", help="do not give screws and spectrum to the registration")
    command.add_argument(
        "--paper", action="store_true", help="also register with the paper's settings: minutes for each load"
    )
    command.add_argument("--out", type=Path, help="output folder; an existing one is continued (default: NAME)")


def _experiment(options: argparse.Namespace) -> Answer:
    from torchkcreg.studies.paper import femoral_plate, tibial_plate

    run = {"tibial-plate": tibial_plate, "femoral-plate": femoral_plate}[options.name]
    out = options.out or Path(options.name)
    table = run(out, quick=options.quick, known=not options.blind, paper=options.paper)
    return Answer(f"\n{table}\n\nfolder {out}", {"folder": out, "table": table})

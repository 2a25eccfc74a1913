"""The command `torchkcreg evaluate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_evaluate(commands) -> None:
    text = "compare a registration with known positions, or with the implant's true shape"
    command = add_command(commands, "evaluate", _evaluate, text)
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, help="x,y,z before, in the implant's frame (CSV)")
    command.add_argument("--truth", type=Path, help="x,y,z of the same points after, in the world (CSV)")
    shapes = "true shape of the deformed implant: mesh (STL, PLY, ...), or points (CSV, XYZ, PLY)"
    command.add_argument("--reference", type=Path, help=shapes)
    kinds = "what a reference's points are: nodes of its volume, or a scan of its surface (default: found out)"
    command.add_argument("--reference-kind", choices=("volume", "surface"), help=kinds)
    command.add_argument("--implant", type=Path, help="undeformed mesh (default: the one that the run names)")
    command.add_argument("--out", type=Path, help="JSON to write")
    command.add_argument("--figures", type=Path, help="folder for displacement map, error map and histogram (PNG)")


def _evaluate(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import evaluate_files
    from torchkcreg.io import write_json

    names = ("points", "truth", "reference", "reference_kind", "implant", "figures")
    found = evaluate_files(options.run_folder, **{name: getattr(options, name) for name in names})
    if options.out:
        write_json(options.out, found.to_dict())
    return Answer(str(found), found.to_dict())

"""`torchkcreg evaluate`: errors of a registration against known positions or a known shape."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_evaluate(commands) -> None:
    """Add the flags of `torchkcreg evaluate`."""
    text = "compare a registration with known positions, or with the implant's true shape"
    command = add_command(commands, "evaluate", _evaluate, text)
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, help="x,y,z of points in the undeformed implant's frame, mm (CSV)")
    command.add_argument("--truth", type=Path, help="x,y,z of the same points in the world after deformation, mm (CSV)")
    shapes = "true shape of the deformed implant: mesh (STL, PLY, ...) or points (CSV, XYZ, PLY)"
    command.add_argument("--reference", type=Path, help=shapes)
    kinds = "whether a reference's points fill its volume or lie on its surface (default: detected)"
    command.add_argument("--reference-kind", choices=("volume", "surface"), help=kinds)
    command.add_argument("--implant", type=Path, help="mesh of the undeformed implant (default: the mesh of the run)")
    command.add_argument("--out", type=Path, help="JSON file to write")
    command.add_argument(
        "--figures", type=Path, help="output folder for displacement map, error map and histogram (PNG)"
    )


def _evaluate(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import evaluate_files
    from torchkcreg.io import write_json

    names = ("points", "truth", "reference", "reference_kind", "implant", "figures")
    evaluation = evaluate_files(options.run_folder, **{name: getattr(options, name) for name in names})
    if options.out:
        write_json(options.out, evaluation.to_dict())
    return Answer(str(evaluation), evaluation.to_dict())

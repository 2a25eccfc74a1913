"""`torchkcreg plan`: choose views before any image is taken."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_plan(commands) -> None:
    """Add the flags of `torchkcreg plan`."""
    text = "rank sets of views by the expected registration error, before any image is taken"
    command = add_command(commands, "plan", _plan, text)
    command.add_argument("--implant", type=Path, required=True, help="closed mesh of the undeformed implant (mm)")
    command.add_argument("--material", required=True, help="material of the implant, such as steel")
    command.add_argument("--geometry", type=Path, required=True, help="projection matrices of all views to choose from")
    command.add_argument("--components", type=Path, help="screws that move with the implant (JSON)")
    command.add_argument("--spectrum", type=Path, help="detected spectrum: energy in keV, weight (CSV)")
    command.add_argument(
        "--init", type=Path, help="pose of the implant: implant_to_world (JSON), or the run folder of a registration"
    )
    command.add_argument("--every", type=int, default=1, metavar="N", help="use only every Nth view as a candidate")
    command.add_argument("--most", type=int, default=6, help="largest number of views in a set (default: 6)")
    command.add_argument("--out", type=Path, default=Path("plan"), help="output folder (default: plan)")
    command.add_argument("--no-figures", action="store_true", help="do not draw the figure")


def _plan(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import plan_files

    names = ("material", "components", "spectrum", "init", "every", "most")
    settings = {name: getattr(options, name) for name in names}
    plan = plan_files(options.implant, options.geometry, options.out, **settings, figures=not options.no_figures)
    return Answer(str(plan), plan.to_dict())

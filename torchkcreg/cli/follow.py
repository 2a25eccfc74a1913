"""`torchkcreg follow`: a fracture over its visits."""

from __future__ import annotations

import argparse
import datetime
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_follow(commands) -> None:
    """Add the flags of `torchkcreg follow`."""
    text = "follow a fracture over visits: motion per newton, load on the implant, stiffness and mineral of the gap"
    command = add_command(commands, "follow", _follow, text)
    command.add_argument(
        "visits", type=Path, nargs="+", metavar="VISIT", help="folders of assess, in the order of time"
    )
    command.add_argument("--dates", type=_date, nargs="+", default=(), metavar="DATE", help="date of each, 2026-12-31")
    command.add_argument("--out", type=Path, required=True, help="output folder")
    command.add_argument("--no-figures", action="store_true", help="do not draw the figure")


def _date(text: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a date is such as 2026-12-31, got {text!r}") from None


def _follow(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import follow

    healing = follow(options.visits, options.out, dates=options.dates, figures=not options.no_figures)
    return Answer(str(healing), healing.to_dict())

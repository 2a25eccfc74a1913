"""``torchkcreg report``: a folder of results as one page."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_report(commands) -> None:
    """Adds the command."""
    text = "write a folder of results as one HTML page: verdict, numbers, pictures, the implant in 3D"
    command = add_command(commands, "report", _report, text)
    command.add_argument("folder", type=Path, help="of a registration, a comparison or a reconstruction")
    command.add_argument("--out", type=Path, help="page to write (default: FOLDER/report.html)")


def _report(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import write_report

    page = write_report(options.folder, out=options.out)
    return Answer(str(page), {"page": page})

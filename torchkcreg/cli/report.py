"""`torchkcreg report`: results folder as one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_report(commands) -> None:
    """Add the flags of `torchkcreg report`."""
    text = "write a results folder as one HTML page: verdict, numbers, figures, the implant in 3D"
    command = add_command(commands, "report", _report, text)
    command.add_argument("folder", type=Path, help="folder of a registration, a comparison or a reconstruction")
    command.add_argument("--out", type=Path, help="page to write (default: FOLDER/report.html)")


def _report(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import ASSESSMENT, write_report, write_visit_page

    write = write_visit_page if (options.folder / ASSESSMENT).is_file() else write_report
    page = write(options.folder, out=options.out)
    return Answer(str(page), {"page": page})

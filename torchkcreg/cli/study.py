"""``torchkcreg study``: many registrations of simulated cases, and what they say."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from torchkcreg.console import Answer

from .command import add_command


def add_study(commands) -> None:
    """Adds the command."""
    text = "register many simulated cases: errors, error bars, wrong geometries, planned views"
    command = add_command(commands, "study", _study, text)
    names = ("population", "coverage", "geometry", "loads", "views")
    command.add_argument("name", choices=names, metavar="NAME", help=", ".join(names))
    command.add_argument("--cases", type=int, help="how many cases (default: what the study usually has)")
    command.add_argument("--first", type=int, default=0, help="seed of the first case")
    sets = ("neighbours", "around", "both", "spread")
    command.add_argument("--views", choices=sets, default="neighbours", help="three or more: neighbours (default), ...")
    command.add_argument("--known", action="store_true", help="screws and spectrum are told")
    command.add_argument("--elastic", action="store_true", help="plates bend under loads that are known")
    images = ("own", "other", "mirrored", "turned")
    command.add_argument("--images", choices=images, default="own", help="images that do not fit: other, ...")
    command.add_argument("--options", type=_options, default={}, help="options of the registration (JSON)")
    command.add_argument("--cache", default="", help="folder that keeps the images")
    command.add_argument("--workers", type=int, default=2, help="processes, a thread each (default: 2)")
    command.add_argument("--cluster", help="address of a Dask scheduler whose workers run the jobs")
    command.add_argument("--out", type=Path, help="folder for table and figures (default: study-NAME); it is taken up")


def _options(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"options must be JSON: {error}") from None
    if not isinstance(found, dict):
        raise argparse.ArgumentTypeError(f"options must be a JSON object, got {text!r}")
    return found


def _study(options: argparse.Namespace) -> Answer:
    from torchkcreg.studies import StudyOptions, run_study

    names = ("cases", "first", "views", "known", "elastic", "images", "options", "cache")
    given = StudyOptions(**{name: getattr(options, name) for name in names})
    out = options.out or Path(f"study-{options.name}")
    rows, text = run_study(options.name, given, out, workers=options.workers, cluster=options.cluster)
    return Answer(f"{text}\nfolder {out}", {"folder": out, "rows": rows})

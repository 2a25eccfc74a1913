"""`torchkcreg study`: statistics over many registrations of simulated cases."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from torchkcreg.console import Answer

from .command import add_command


def add_study(commands) -> None:
    """Add the flags of `torchkcreg study`."""
    text = "register many simulated cases: errors, error bars, wrong geometries, planned views"
    command = add_command(commands, "study", _study, text)
    names = ("population", "coverage", "geometry", "loads", "views")
    command.add_argument("name", choices=names, metavar="NAME", help=", ".join(names))
    command.add_argument("--cases", type=int, help="number of cases (default: depends on the study)")
    command.add_argument("--first", type=int, default=0, help="seed of the first case")
    sets = ("neighbours", "around", "both", "spread")
    command.add_argument(
        "--views",
        choices=sets,
        default="neighbours",
        help="which views to use: neighbours (default), around, both or spread",
    )
    command.add_argument("--known", action="store_true", help="give screws and spectrum to the registration")
    command.add_argument("--elastic", action="store_true", help="simulate plates that bend under known loads")
    images = ("own", "other", "mirrored", "turned")
    command.add_argument(
        "--images",
        choices=images,
        default="own",
        help="own (default), or images that do not belong to the case: other, mirrored, turned",
    )
    command.add_argument("--options", type=_options, default={}, help="registration options (JSON object)")
    command.add_argument("--cache", default="", help="folder in which simulated images are cached")
    command.add_argument("--workers", type=int, default=2, help="number of processes, one thread each (default: 2)")
    command.add_argument("--cluster", help="address of a Dask scheduler whose workers run the jobs")
    command.add_argument("--out", type=Path, help="output folder; an existing one is continued (default: study-NAME)")


def _options(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"options must be JSON: {error}") from None
    if not isinstance(content, dict):
        raise argparse.ArgumentTypeError(f"options must be a JSON object, got {text!r}")
    return content


def _study(options: argparse.Namespace) -> Answer:
    from torchkcreg.studies import StudyOptions, run_study

    names = ("cases", "first", "views", "known", "elastic", "images", "options", "cache")
    settings = StudyOptions(**{name: getattr(options, name) for name in names})
    out = options.out or Path(f"study-{options.name}")
    rows, text = run_study(options.name, settings, out, workers=options.workers, cluster=options.cluster)
    return Answer(f"{text}\nfolder {out}", {"folder": out, "rows": rows})

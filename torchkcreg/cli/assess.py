"""`torchkcreg assess`: how a fracture moves under load, from the scans of a visit."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import FAILED, add_command


def add_assess(commands) -> None:
    """Add the flags of `torchkcreg assess`."""
    text = "measure how a fracture moves under load and what its implant carries, from the scans of a visit"
    command = add_command(commands, "assess", _assess, text)
    command.add_argument("--implant", type=Path, required=True, help="closed mesh of the undeformed implant (mm)")
    command.add_argument("--material", required=True, help="material of the implant, such as steel")
    command.add_argument("--geometry", type=Path, required=True, help="projection matrices of all scans")
    command.add_argument("--unloaded", type=Path, required=True, help="projections without load")
    command.add_argument("--loaded", type=Path, nargs="+", required=True, help="projections under load, a file each")
    command.add_argument("--loads", type=float, nargs="+", default=(), metavar="N", help="load of each, in newtons")
    command.add_argument("--screws", type=Path, help="screws that move with the implant (JSON), if known")
    command.add_argument("--spectrum", type=Path, help="detected spectrum: energy in keV, weight (CSV), if known")
    views = "views to register with: 15,16,17 or 4-10 or 0:200:20; default: all of up to 15, of more the 12 that lie "
    command.add_argument("--views", type=_views, help=f"{views}furthest apart")
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, if the files do not give it")
    at = "point in the implant's frame whose translation leads, mm (default: the middle of the fracture in the implant)"
    command.add_argument("--at", type=float, nargs=3, metavar=("X", "Y", "Z"), help=at)
    command.add_argument("--config", type=Path, help="options of the registrations as YAML or JSON")
    command.add_argument("--out", type=Path, required=True, help="output folder")
    command.add_argument("--no-volumes", action="store_true", help="do not reconstruct the unloaded scan")
    command.add_argument("--spacing", type=float, default=0.8, help="voxel size of the volumes, mm (default: 0.8)")
    command.add_argument("--no-figures", action="store_true", help="do not draw figures")
    existing = command.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace existing runs in the folder")
    existing.add_argument("--resume", action="store_true", help="go on where an interrupted assessment ended")


def _views(text: str) -> list[int] | None:
    from .register import views_of

    views = views_of(text)
    if views == "all":
        raise argparse.ArgumentTypeError("all views of a scan take hours: name some, such as 0:200:10")
    return views if isinstance(views, list) else None


def _assess(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import VisitFiles, assess

    names = ("implant", "material", "geometry", "unloaded", "loaded", "loads", "screws", "spectrum", "views")
    files = VisitFiles(**{name: getattr(options, name) for name in (*names, "open_beam", "at", "config")})
    assessment = assess(
        files,
        options.out,
        overwrite=options.overwrite,
        resume=options.resume,
        figures=not options.no_figures,
        volumes=not options.no_volumes,
        spacing_mm=options.spacing,
    )
    lost = all(c.status == "failed" for c in assessment.configurations)
    return Answer(str(assessment), assessment.to_dict(), FAILED if lost else 0)

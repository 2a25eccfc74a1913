"""The command ``torchkcreg register``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from torchkcreg.console import Answer

from .command import add_command

FAILED = 3  # exit status


def add_register(commands) -> None:
    command = add_command(commands, "register", _register, "measure the deformation of an implant in a few projections")
    mesh = "closed mesh of the undeformed implant (mm); repeated, with --components, --init and --material, for several"
    command.add_argument("--implant", type=Path, action="append", required=True, help=mesh)
    command.add_argument(
        "--geometry", type=Path, required=True, help="projection matrices (JSON, XML, NPY, CSV, DICOM)"
    )
    command.add_argument(
        "--projections",
        type=Path,
        required=True,
        help="intensities or line integrals (NPZ, MHA, TIFF, a folder, YAML, ...)",
    )
    command.add_argument("--out", type=Path, required=True, help="run folder to make")
    command.add_argument("--views", type=_integers, help="views to use, such as 15,16,17 (default: all)")
    steel = "material of the implant, such as steel: polyenergetic DRRs"
    command.add_argument("--material", action="append", help=steel)
    command.add_argument("--spectrum", type=Path, help="detected spectrum: energy in keV, weight (CSV)")
    screws = "screws that move with the implant (JSON); - for none of one of several"
    command.add_argument("--components", type=_path_or_none, action="append", help=screws)
    start = "approximate implant_to_world (JSON), or the run folder of an earlier registration, such as without load"
    command.add_argument("--init", type=_path_or_none, action="append", help=start)
    rest = "run folder of a registration without load: finite elements bend the implant from that shape"
    command.add_argument("--rest", type=_path_or_none, action="append", help=rest)
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, where the file does not say it")
    command.add_argument("--config", type=Path, help="options as YAML or JSON; flags override it")
    command.add_argument("--preset", help="schedule: gauss-newton, paper (CMA-ES) or adam")
    command.add_argument(
        "--deformation",
        help="how it bends: modes (elastic modes, default), fe (loads at its holes), ffd (the paper's), auto",
    )
    command.add_argument("--pitch", type=float, dest="pitch_mm", help="pitch of the implant's nodes, mm")
    command.add_argument("--seed", type=int, help="seed of the random numbers")
    command.add_argument("--seeds", type=int, metavar="N", help="run N seeds, keep the best, report their spread")
    command.add_argument("--backend", help="projector: auto, cpp, triton or torch")
    command.add_argument("--device", help="where it is computed: cpu (default), cuda, cuda:1, ...")
    dry = "read and check everything, say and draw where the implant lies at the start (OUT-start.png), and stop"
    command.add_argument("--dry-run", action="store_true", help=dry)
    command.add_argument("--no-figures", action="store_true", help="leave the pictures out")
    existing = command.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace the run that the folder holds")
    existing.add_argument("--resume", action="store_true", help="continue the run that the folder holds")


def _path_or_none(text: str) -> Path | None:
    return None if text == "-" else Path(text)


def _only(values: list | None) -> Any:
    """The one of a repeatable flag that was given once; a list where it was repeated."""
    return values[0] if values is not None and len(values) == 1 else values


def _integers(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"views must be integers separated by commas, got {text!r}") from None


def _register(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import RegistrationFiles, dry_run, register_files, register_seeds

    if options.seeds is not None and options.resume:
        raise ValueError("--seeds cannot be resumed: leave --resume or --seeds out")
    named = ("geometry", "projections", "spectrum", "views", "open_beam", "config")
    each = {name: _only(getattr(options, name)) for name in ("implant", "components", "init", "rest")}
    materials = options.material if options.material and len(options.material) > 1 else None
    files = RegistrationFiles(**each, materials=materials, **{name: getattr(options, name) for name in named})
    names = ("preset", "deformation", "pitch_mm", "seed", "backend", "device")
    overrides = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    overrides |= {"material": options.material[0]} if options.material else {}
    if options.dry_run:
        picture = None if options.no_figures else options.out.with_name(f"{options.out.name}-start.png")
        lines = dry_run(files, picture, overrides=overrides)
        return Answer("\n".join(lines), {"said": lines, "picture": picture})
    said = ""
    how = {"overrides": overrides, "overwrite": options.overwrite, "figures": not options.no_figures}
    if options.seeds is not None:
        runs = register_seeds(files, options.out, options.seeds, **how)
        result = runs.result
        said = f"{runs}\n"
    else:
        result = register_files(files, options.out, resume=options.resume, **how)
    similarity = " ".join(f"{gc:.3f}" for gc in result.gc.tolist())
    said += f"{result.status}: gradient correlation of each view {similarity}; run folder {options.out}"
    data = {"folder": options.out, "status": result.status, "reasons": result.warnings, "gc": result.gc.tolist()}
    return Answer(said, data, FAILED if result.status == "failed" else 0)

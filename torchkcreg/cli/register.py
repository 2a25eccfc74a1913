"""`torchkcreg register`: measure the pose and deformation of an implant."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from torchkcreg.console import Answer

from .command import FAILED, add_command


def add_register(commands) -> None:
    """Add the flags of `torchkcreg register`."""
    command = add_command(
        commands, "register", _register, "measure the pose and deformation of an implant from a few X-ray views"
    )
    mesh = "closed mesh of the undeformed implant (mm); for several implants, repeat it, --components, --init, ..."
    command.add_argument("--implant", type=Path, action="append", help=mesh)
    command.add_argument("--geometry", type=Path, help="projection matrices (JSON, XML, NPY, CSV, DICOM)")
    command.add_argument(
        "--projections",
        type=Path,
        help="intensities or line integrals (NPZ, MHA, TIFF, a folder, YAML, ...)",
    )
    frames = "projections of several frames of the same geometry, instead of --projections: each starts from the one "
    frames += "before it; writes a run folder a frame and the motion over them"
    command.add_argument("--frames", type=Path, nargs="+", metavar="PROJECTIONS", help=frames)
    command.add_argument("--out", type=Path, required=True, help="run folder to write")
    command.add_argument(
        "--views",
        type=views_of,
        help="views to use: 15,16,17 or 4-10 or 0:200:20 (from, before, step), or all; auto (default): of more than 24 "
        "those 24 that lie furthest apart",
    )
    steel = "material of the implant, such as steel: makes DRRs polyenergetic; always give it"
    command.add_argument("--material", action="append", help=steel)
    command.add_argument("--spectrum", type=Path, help="detected spectrum: energy in keV, weight (CSV)")
    screws = "screws that move with the implant (JSON); with several implants, - if this one has none"
    command.add_argument("--components", type=_path_or_none, action="append", help=screws)
    start = "start pose: implant_to_world (JSON), or the run folder of an earlier registration, such as without load"
    command.add_argument("--init", type=_path_or_none, action="append", help=start)
    command.add_argument(
        "--start",
        choices=("auto", "given", "search"),
        help="auto (default): search for the implant if the start pose does not agree with the images; given: start "
        "from --init or the mesh's own frame; search: always search",
    )
    rest = "run folder of a registration without load: its shape is the rest shape of the finite elements"
    command.add_argument("--rest", type=_path_or_none, action="append", help=rest)
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, if the file does not give it")
    options = "options as YAML or JSON, or the config.yaml of a run to repeat it; flags override it"
    command.add_argument("--config", type=Path, help=options)
    command.add_argument("--preset", help="optimization schedule: gauss-newton, paper (CMA-ES) or adam")
    command.add_argument(
        "--deformation",
        help="deformation model: modes (elastic modes, default), fe (loads at the holes), ffd (the paper's), "
        "rigid (a joint component, a screw), auto",
    )
    command.add_argument("--pitch", type=float, dest="pitch_mm", help="spacing of the implant's nodes, mm")
    command.add_argument("--seed", type=int, help="random seed")
    command.add_argument(
        "--seeds", type=int, metavar="N", help="register with N seeds, keep the best, report the spread"
    )
    command.add_argument("--backend", help="projector: auto, cpp, triton or torch")
    command.add_argument("--device", help="PyTorch device: cpu (default), cuda, cuda:1, ...")
    dry = "read and check all inputs, report and draw the start pose (OUT-start.png), then stop"
    command.add_argument("--dry-run", action="store_true", help=dry)
    command.add_argument("--no-figures", action="store_true", help="do not draw figures")
    existing = command.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace an existing run in the folder")
    existing.add_argument("--resume", action="store_true", help="continue the run in the folder")


def _path_or_none(text: str) -> Path | None:
    return None if text == "-" else Path(text)


def _only(values: list | None) -> Any:
    """Value of a repeatable flag: a single value if it was given once, else the list."""
    return values[0] if values is not None and len(values) == 1 else values


def views_of(text: str) -> list[int] | str:
    """Views such as 3,4-10,0:200:20 as a list; "all" and "auto" as they are."""
    if text in ("all", "auto"):
        return text
    views: list[int] = []
    try:
        for part in text.split(","):
            if ":" in part:
                start, stop, step = (int(number) for number in [*part.split(":"), "1"][:3])
                views += range(start, stop, step)
            elif "-" in part.strip()[1:]:
                first, last = (int(number) for number in part.split("-"))
                views += range(first, last + 1)
            else:
                views.append(int(part))
    except ValueError:
        views = []
    if not views:
        raise argparse.ArgumentTypeError(f"views must be such as 3,4-10,0:200:20 or all or auto, got {text!r}")
    return views


def _register(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import RegistrationFiles, dry_run, register_files, register_frames, register_seeds
    from torchkcreg.io import read_config

    if options.seeds is not None and options.resume:
        raise ValueError("--seeds cannot be resumed: leave --resume or --seeds out")
    if options.frames is not None:
        for name in ("projections", "seeds"):
            if getattr(options, name) is not None:
                raise ValueError(f"--frames and --{name} exclude each other")
        options.projections = options.frames[0]
    single = ("geometry", "projections", "spectrum", "views", "open_beam", "config")
    per_implant = {name: _only(getattr(options, name)) for name in ("implant", "components", "init", "rest")}
    materials = options.material if options.material and len(options.material) > 1 else None
    given = {**per_implant, "materials": materials, **{name: getattr(options, name) for name in single}}
    files = RegistrationFiles.of(given)
    names = ("preset", "start", "deformation", "pitch_mm", "seed", "backend", "device")
    overrides = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    overrides |= {"material": options.material[0]} if options.material else {}
    if options.dry_run:
        picture = None if options.no_figures else options.out.with_name(f"{options.out.name}-start.png")
        lines = dry_run(files, picture, overrides=overrides)
        return Answer("\n".join(lines), {"said": lines, "picture": picture})
    summary = ""
    settings = {"overrides": overrides, "overwrite": options.overwrite, "figures": not options.no_figures}
    if options.frames is not None:
        series = register_frames(files, options.frames, options.out, resume=options.resume, **settings)
        lost = all(status == "failed" for status in series.statuses)
        return Answer(str(series), series.to_dict(), FAILED if lost else 0)
    if options.seeds is not None:
        runs = register_seeds(files, options.out, options.seeds, **settings)
        result = runs.result
        summary = f"{runs}\n"
    else:
        result = register_files(files, options.out, resume=options.resume, **settings)
    if files.views is None and (used := read_config(options.out / "config.yaml")["files"].get("views")):
        summary += f"{len(used)} views, spread over all directions: {', '.join(map(str, used))}\n"
    if result.searched:
        summary += f"searched, since the start pose does not agree with the images: {', '.join(result.searched)}\n"
    similarity = " ".join(f"{gc:.3f}" for gc in result.gc.tolist())
    summary += f"{result.status}: gradient correlation of each view {similarity}; run folder {options.out}"
    data = {"folder": options.out, "status": result.status, "reasons": result.warnings, "gc": result.gc.tolist()}
    return Answer(summary, data, FAILED if result.status == "failed" else 0)

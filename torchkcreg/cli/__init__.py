"""The command line: ``torchkcreg register | warp | evaluate | load | compare | simulate | reconstruct | ...``."""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import torchkcreg
from torchkcreg.console import Answer, one_line, run_command

from .command import add_command, voice_of
from .compare import add_compare
from .completion import add_completion
from .convert import add_convert
from .densitometry import add_densitometry
from .doctor import add_doctor
from .experiment import add_experiment
from .load import add_load
from .plan import add_plan
from .register import add_register
from .report import add_report
from .simulate import add_simulate
from .study import add_study

# Before torch starts its threads. Between small operations they wait by spinning for a few microseconds: asleep at
# once, they double the time of a registration; spinning for long, they stop each other where other programs run.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit status.

    0, or 2 after a one-line error that names what was wrong, or 3 after a registration whose result, which is written,
    is not to be trusted.
    """
    try:
        options = _parser().parse_args(arguments)
    except SystemExit as done:  # argparse is done after --help, --version, or a wrong flag
        return int(done.code or 0)
    return run_command(f"torchkcreg {options.command}", lambda: options.run(options), voice_of(options))


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like all the others."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {one_line(message)}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchkcreg", description=torchkcreg.__doc__)
    parser.add_argument("--version", action="version", version=f"torchkcreg {torchkcreg.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_register(commands)
    _add_warp(commands)
    _add_evaluate(commands)
    add_load(commands)
    add_densitometry(commands)
    add_compare(commands)
    add_report(commands)
    add_convert(commands)
    add_plan(commands)
    add_simulate(commands)
    add_experiment(commands)
    add_study(commands)
    _add_reconstruct(commands)
    _add_info(commands)
    add_doctor(commands)
    add_completion(commands, _parser)
    _add_demo(commands)
    return parser


def _add_warp(commands) -> None:
    command = add_command(commands, "warp", _warp, "move points of the undeformed implant's frame to the world")
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, required=True, help="x,y,z in the implant's frame, mm (CSV)")
    command.add_argument(
        "--out", type=Path, required=True, help="CSV to write: x,y,z in the world, outside or not, deviations"
    )
    command.add_argument("--implant-name", help="of several implants, the one whose frame the points are in (its file)")


def _warp(options: argparse.Namespace) -> Answer:
    from torchkcreg.io import read_points, read_run, write_points

    result, points = read_run(options.run_folder), read_points(options.points)
    try:
        implant = result.implant(options.implant_name)
    except KeyError as error:
        raise ValueError(f"run folder {options.run_folder}: {error.args[0]}") from None
    outside = implant.outside(points)
    if outside.any():
        warnings.warn(
            f"{int(outside.sum())} of {len(points)} points lie beyond the implant's reach: "
            "they move rigidly with its nearest part",
            stacklevel=1,
        )
    columns = {"outside": outside}
    if implant.deviations is not None:
        columns |= dict(zip(("lateral_std_mm", "depth_std_mm"), implant.deviations.split(points), strict=True))
    write_points(options.out, implant.warp(points), **columns)
    return Answer("", {"out": options.out, "points": len(points), "outside": int(outside.sum())})


def _add_evaluate(commands) -> None:
    text = "compare a registration with known positions, or with the implant's true shape"
    command = add_command(commands, "evaluate", _evaluate, text)
    command.add_argument("--run", type=Path, required=True, help="folder of a finished registration", dest="run_folder")
    command.add_argument("--points", type=Path, help="x,y,z before, in the implant's frame (CSV)")
    command.add_argument("--truth", type=Path, help="x,y,z of the same points after, in the world (CSV)")
    shapes = "true shape of the deformed implant: mesh (STL, PLY, ...), or points (CSV, XYZ, PLY)"
    command.add_argument("--reference", type=Path, help=shapes)
    kinds = "what a reference's points are: nodes of its volume, or a scan of its surface (default: found out)"
    command.add_argument("--reference-kind", choices=("volume", "surface"), help=kinds)
    command.add_argument("--implant", type=Path, help="undeformed mesh (default: the one that the run names)")
    command.add_argument("--out", type=Path, help="JSON to write")
    command.add_argument("--figures", type=Path, help="folder for displacement map, error map and histogram (PNG)")


def _evaluate(options: argparse.Namespace) -> Answer:
    from torchkcreg.experiments import evaluate_files
    from torchkcreg.io import write_json

    names = ("points", "truth", "reference", "reference_kind", "implant", "figures")
    found = evaluate_files(options.run_folder, **{name: getattr(options, name) for name in names})
    if options.out:
        write_json(options.out, found.to_dict())
    return Answer(str(found), found.to_dict())


def _add_reconstruct(commands) -> None:
    command = add_command(
        commands, "reconstruct", _reconstruct, "make a volume from a scan: FDK, PWLS, KC-MAR or KC-Rec"
    )
    command.add_argument("--method", choices=("fdk", "pwls", "kcmar", "kcrec"), default="fdk", help="default: fdk")
    command.add_argument("--run", type=Path, dest="run_folder", help="registration: the implant, and files not given")
    command.add_argument("--geometry", type=Path, help="projection matrices of all views (JSON)")
    command.add_argument("--projections", type=Path, help="intensities or line integrals of all views (NPZ, MHA)")
    command.add_argument("--out", type=Path, required=True, help="folder to make")
    command.add_argument("--spectrum", type=Path, help="detected spectrum, to correct beam hardening (CSV)")
    command.add_argument("--components", type=Path, help="screws, where the registration did not know them (JSON)")
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, where the file does not say it")
    command.add_argument("--initial", type=Path, help="volume to start PWLS from (MHA, NIfTI)")
    command.add_argument("--config", type=Path, help="options as YAML or JSON; flags override it")
    command.add_argument("--spacing", type=float, dest="spacing_mm", help="edge of a voxel, mm (default: 0.8)")
    command.add_argument("--size", type=float, nargs=3, dest="size_mm", metavar=("X", "Y", "Z"), help="volume, mm")
    command.add_argument(
        "--center", type=float, nargs=3, dest="center_mm", metavar=("X", "Y", "Z"), help="its middle, mm"
    )
    fine = "divide voxels near known metal into so many along each edge (kcrec)"
    command.add_argument("--refine", type=int, metavar="N", help=fine)
    command.add_argument("--refine-within", type=float, dest="refine_within_mm", metavar="MM", help="default: 5")
    command.add_argument("--preset", help="momentum (50 iterations) or paper (500 of 20 subsets)")
    command.add_argument("--iterations", type=int, help="passes through all views")
    command.add_argument("--subsets", type=int, help="ordered subsets")
    command.add_argument("--beta", type=float, help="weight of the roughness (default: 10)")
    command.add_argument(
        "--passes", type=int, help="2: correct for mineral and scatter behind metal, from pass 1 (default of kcrec)"
    )
    command.add_argument("--window", help="of the ramp: ram-lak, shepp-logan, cosine, hamming or hann (default)")
    command.add_argument("--scatter", help="auto (default), run (as found), none, or its fraction")
    command.add_argument("--monoenergetic", action="store_true", default=None, help="one energy, as in the paper")
    streamed = "read some views at a time, of scans larger than memory (NPY, uncompressed MHA)"
    command.add_argument("--stream", action="store_true", default=None, help=streamed)
    estimated = "given (default), run (as hard as found), or estimate: where spectrum or alloy are not known"
    command.add_argument("--beam", choices=("given", "run", "estimate"), help=estimated)
    scale = "attenuation over water of what most of the object is, for --beam estimate: 1 in a water bath"
    command.add_argument("--soft-tissue", type=float, metavar="SHARE", help=scale)
    command.add_argument("--material", help="of the implant, where the registration had none")
    alone = "the object is of this material alone, such as an implant on a bench: fdk gives its share in each voxel"
    command.add_argument("--single-material", metavar="NAME", help=alone)
    command.add_argument("--no-figures", action="store_true", help="leave the pictures out")
    existing = command.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace the reconstruction that the folder holds")
    existing.add_argument("--resume", action="store_true", help="continue the one that the folder holds")


def _reconstruct(options: argparse.Namespace) -> Answer:
    from torchkcreg.experiments import ReconstructionFiles, ReconstructionOptions, reconstruct_files, resolve_options

    names = ("geometry", "projections", "spectrum", "components", "open_beam", "initial")
    files = ReconstructionFiles(run=options.run_folder, **{name: getattr(options, name) for name in names})
    given = {name: getattr(options, name, None) for name in ReconstructionOptions.model_fields}
    overrides = {name: value for name, value in given.items() if value is not None}
    metrics = reconstruct_files(
        files,
        options.out,
        resolve_options(overrides, options.config),
        overwrite=options.overwrite,
        resume=options.resume,
        figures=not options.no_figures,
    )
    depth, height, width = metrics["shape"]
    text = f"{width} x {height} x {depth} voxels in {metrics['seconds']:.0f} s; folder {options.out}"
    return Answer(text, {**metrics, "folder": options.out})


def _add_info(commands) -> None:
    command = add_command(commands, "info", _info, "say what a file or a run folder holds, or what is installed")
    command.add_argument("paths", type=Path, nargs="*", help="meshes, geometries, projections, run folders")
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, where projections do not say it")
    drawn = "figure to write of a geometry: focal spots and detectors in three dimensions (PNG, PDF, SVG)"
    command.add_argument("--picture", type=Path, help=drawn)


def _info(options: argparse.Namespace) -> Answer:
    from torchkcreg.experiments import describe, describe_installation, picture_geometry, runs_compared

    if options.picture is not None:
        picture_geometry(options.paths, options.picture)
    told = {str(path): describe(path, open_beam=options.open_beam) for path in options.paths}
    texts = list(told.values()) or [describe_installation()]
    if compared := runs_compared(options.paths):
        texts.append(compared)
    return Answer("\n".join(texts), {"files": told} if told else {"installation": texts[0].splitlines()})


def _add_demo(commands) -> None:
    command = add_command(commands, "demo", _demo, "simulate a loaded plate, register it, evaluate and draw the result")
    command.add_argument("--out", type=Path, default=Path("demo"), help="folder to make")
    command.add_argument("--seed", type=int, default=0, help="seed of the simulated noise")
    command.add_argument("--overwrite", action="store_true", help="replace the demo that the folder holds")


def _demo(options: argparse.Namespace) -> Answer:
    from torchkcreg.experiments import demo

    demo(options.out, seed=options.seed, overwrite=options.overwrite)
    return Answer("", {"folder": options.out})

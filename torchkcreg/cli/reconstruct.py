"""`torchkcreg reconstruct`: reconstruct a volume from a scan."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_reconstruct(commands) -> None:
    """Add the flags of `torchkcreg reconstruct`."""
    command = add_command(
        commands, "reconstruct", _reconstruct, "reconstruct a volume from a scan: FDK, PWLS, KC-MAR or KC-Rec"
    )
    command.add_argument("--method", choices=("fdk", "pwls", "kcmar", "kcrec"), default="fdk", help="default: fdk")
    command.add_argument(
        "--run",
        type=Path,
        dest="run_folder",
        help="run folder of a registration: gives the implant, and the files that are not named here",
    )
    command.add_argument("--geometry", type=Path, help="projection matrices of all views (JSON)")
    command.add_argument("--projections", type=Path, help="intensities or line integrals of all views (NPZ, MHA)")
    command.add_argument("--out", type=Path, required=True, help="output folder")
    command.add_argument("--spectrum", type=Path, help="detected spectrum, to correct beam hardening (CSV)")
    command.add_argument("--components", type=Path, help="screws, if the registration did not have them (JSON)")
    command.add_argument("--open-beam", type=float, help="unattenuated intensity, if the file does not give it")
    command.add_argument("--initial", type=Path, help="volume to start PWLS from (MHA, NIfTI)")
    command.add_argument("--config", type=Path, help="options as YAML or JSON; flags override it")
    command.add_argument("--spacing", type=float, dest="spacing_mm", help="voxel size, mm (default: 0.8)")
    command.add_argument(
        "--size", type=float, nargs=3, dest="size_mm", metavar=("X", "Y", "Z"), help="size of the volume, mm"
    )
    command.add_argument(
        "--center", type=float, nargs=3, dest="center_mm", metavar=("X", "Y", "Z"), help="center of the volume, mm"
    )
    fine = "divide voxels near known metal into N along each edge (kcrec)"
    command.add_argument("--refine", type=int, metavar="N", help=fine)
    command.add_argument(
        "--refine-within", type=float, dest="refine_within_mm", metavar="MM", help="distance for --refine (default: 5)"
    )
    command.add_argument("--preset", help="momentum (50 iterations) or paper (500 iterations of 20 subsets)")
    command.add_argument("--iterations", type=int, help="passes through all views")
    command.add_argument("--subsets", type=int, help="ordered subsets")
    command.add_argument("--beta", type=float, help="weight of the roughness penalty (default: 10)")
    command.add_argument(
        "--passes",
        type=int,
        help="2: use pass 1 to correct for bone mineral and for scatter behind metal (default of kcrec)",
    )
    command.add_argument(
        "--window", help="window of the ramp filter: ram-lak, shepp-logan, cosine, hamming or hann (default)"
    )
    command.add_argument(
        "--scatter",
        help="auto (default), run (estimate of the registration), none, or scatter over primary as a number",
    )
    command.add_argument(
        "--monoenergetic", action="store_true", default=None, help="ignore the spectrum: one energy, as in the paper"
    )
    streamed = "read a few views at a time, for scans larger than memory (NPY, uncompressed MHA)"
    command.add_argument("--stream", action="store_true", default=None, help=streamed)
    estimated = (
        "given (default), run (hardness found by the registration), or estimate (if spectrum or alloy are unknown)"
    )
    command.add_argument("--beam", choices=("given", "run", "estimate"), help=estimated)
    scale = "for --beam estimate: attenuation of most of the object relative to water, 1 in a water bath"
    command.add_argument("--soft-tissue", type=float, metavar="SHARE", help=scale)
    command.add_argument("--material", help="material of the implant, if the registration had none")
    alone = "the object is only this material, such as an implant on a bench: fdk gives its fraction per voxel"
    command.add_argument("--single-material", metavar="NAME", help=alone)
    command.add_argument("--no-figures", action="store_true", help="do not draw figures")
    existing = command.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace an existing reconstruction in the folder")
    existing.add_argument("--resume", action="store_true", help="continue the reconstruction in the folder")


def _reconstruct(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import ReconstructionFiles, ReconstructionOptions, reconstruct_files, resolve_options

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

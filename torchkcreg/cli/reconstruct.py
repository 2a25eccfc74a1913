"""The command `torchkcreg reconstruct`."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_reconstruct(commands) -> None:
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

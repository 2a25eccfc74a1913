"""`torchkcreg convert`: convert geometries, meshes and projections between file formats."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_convert(commands) -> None:
    """Add the flags of `torchkcreg convert`."""
    text = "convert a geometry, a mesh or projections; the target's suffix gives the format"
    command = add_command(commands, "convert", _convert, text)
    command.add_argument("source", type=Path, help="geometry, mesh or projections, in any format that can be read")
    command.add_argument(
        "target",
        type=Path,
        help="geometry: JSON, XML, NPY, NPZ, CSV; mesh: STL, PLY, OBJ, OFF; line integrals: MHA, NRRD, NII",
    )
    command.add_argument(
        "--projections", type=Path, help="image whose header gives number and size of the pixels (MHA, NRRD)"
    )
    command.add_argument("--rows", type=int, help="detector rows, if no header gives them")
    command.add_argument("--cols", type=int, help="detector columns, if no header gives them")
    pitch = "pixel pitch: one number, or between rows and between columns"
    command.add_argument("--pixel-pitch", type=float, nargs="+", metavar="MM", help=pitch)
    layout = "meaning of twelve numbers per view: matrices, or astra (source, detector, column step, row step in mm)"
    command.add_argument("--layout", choices=("matrices", "astra"), help=layout)
    axis = "rotation axis of the gantry in the source's world (RTK: y); in the target it is z"
    command.add_argument("--gantry-axis", choices=("x", "y", "z"), default="z", help=axis)
    command.add_argument(
        "--open-beam", type=float, help="unattenuated intensity of projections, if their file does not give it"
    )
    command.add_argument("--overwrite", action="store_true", help="replace the target if it exists")


def _convert(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import convert

    summary = convert(
        options.source,
        options.target,
        projections=options.projections,
        det_shape=None if options.rows is None or options.cols is None else (options.rows, options.cols),
        pixel_spacing=options.pixel_pitch,
        layout=options.layout,
        gantry_axis=options.gantry_axis,
        open_beam=options.open_beam,
        overwrite=options.overwrite,
    )
    return Answer(summary, {"target": options.target, "said": summary})

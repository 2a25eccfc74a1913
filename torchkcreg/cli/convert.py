"""``torchkcreg convert``: geometries, meshes and projections from one format into another."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_convert(commands) -> None:
    """Adds the command."""
    text = "convert a geometry, a mesh or projections into another format, by the target's ending"
    command = add_command(commands, "convert", _convert, text)
    command.add_argument("source", type=Path, help="geometry, mesh, or projections: any that is read")
    command.add_argument(
        "target",
        type=Path,
        help="geometry: JSON, XML, NPY, NPZ, CSV; mesh: STL, PLY, OBJ, OFF; line integrals: MHA, NRRD, NII",
    )
    command.add_argument("--projections", type=Path, help="image whose header says what the pixels are (MHA, NRRD)")
    command.add_argument("--rows", type=int, help="of the detector, where no header says it")
    command.add_argument("--cols", type=int, help="of the detector")
    pitch = "between rows and between columns, one number or two"
    command.add_argument("--pixel-pitch", type=float, nargs="+", metavar="MM", help=pitch)
    layout = "of twelve numbers a view: matrices, or astra (source, detector, column step, row step in mm)"
    command.add_argument("--layout", choices=("matrices", "astra"), help=layout)
    axis = "the source's world has this axis for the gantry's (RTK: y); the target's has z"
    command.add_argument("--gantry-axis", choices=("x", "y", "z"), default="z", help=axis)
    command.add_argument("--open-beam", type=float, help="of projections, where their file does not say it")
    command.add_argument("--overwrite", action="store_true", help="replace the target")


def _convert(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import convert

    said = convert(
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
    return Answer(said, {"target": options.target, "said": said})

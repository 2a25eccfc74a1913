"""`torchkcreg densitometry`: bone mineral density near an implant."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_densitometry(commands) -> None:
    """Add the flags of `torchkcreg densitometry`."""
    text = "measure bone mineral density in regions of a reconstruction (calcium, mg/mL)"
    command = add_command(commands, "densitometry", _densitometry, text)
    command.add_argument("reconstruction", type=Path, metavar="FOLDER", help="output folder of torchkcreg reconstruct")
    ends = ("X1", "Y1", "Z1", "X2", "Y2", "Z2", "RADIUS")
    region = "cylindrical region: both ends of the axis and the radius, mm; can be repeated"
    command.add_argument("--cylinder", type=float, nargs=7, action="append", default=[], metavar=ends, help=region)
    command.add_argument("--labels", type=Path, help="label map on the same voxels: each label above zero is a region")
    near = "ignore voxels closer to metal than this (default: 1.5)"
    command.add_argument("--from-metal", type=float, default=1.5, metavar="MM", help=near)
    command.add_argument("--out", type=Path, help="output folder (default: FOLDER/densitometry)")
    command.add_argument("--no-figures", action="store_true", help="do not draw the figure")


def _densitometry(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import densitometry_files

    regions = densitometry_files(
        options.reconstruction,
        options.out or options.reconstruction / "densitometry",
        cylinders=options.cylinder,
        labels=options.labels,
        from_metal_mm=options.from_metal,
        figures=not options.no_figures,
    )
    lines = [f"{'region':12} {'mL':>8} {'calcium':>10} {'std':>7} {'HA':>8}  mg/mL"]
    for region in regions:
        text = f"{region.name:12} {region.volume_ml:8.3f} {region.calcium_mg_ml:10.1f} {region.std_mg_ml:7.1f}"
        near_metal = f"  ({100 * region.left_out:.0f} % left out)" if region.left_out else ""
        lines.append(f"{text} {region.hydroxyapatite_mg_ml:8.1f}{near_metal}")
    return Answer("\n".join(lines), {"regions": [vars(region) for region in regions]})

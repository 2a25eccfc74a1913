"""``torchkcreg densitometry``: bone mineral near an implant."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchkcreg.console import Answer

from .command import add_command


def add_densitometry(commands) -> None:
    """Adds the command."""
    text = "measure bone mineral in regions of a reconstruction: calcium in mg/mL"
    command = add_command(commands, "densitometry", _densitometry, text)
    command.add_argument("reconstruction", type=Path, metavar="FOLDER", help="folder that reconstruct made")
    ends = ("X1", "Y1", "Z1", "X2", "Y2", "Z2", "RADIUS")
    region = "region: two ends of an axis and a radius, mm; repeated for several"
    command.add_argument("--cylinder", type=float, nargs=7, action="append", default=[], metavar=ends, help=region)
    command.add_argument("--labels", type=Path, help="label map on the same voxels: each number is a region")
    near = "voxels nearer to metal than this don't count (default: 1.5)"
    command.add_argument("--from-metal", type=float, default=1.5, metavar="MM", help=near)
    command.add_argument("--out", type=Path, help="folder for table and figure (default: FOLDER/densitometry)")
    command.add_argument("--no-figures", action="store_true", help="leave the picture out")


def _densitometry(options: argparse.Namespace) -> Answer:
    from torchkcreg.commands import densitometry_files

    found = densitometry_files(
        options.reconstruction,
        options.out or options.reconstruction / "densitometry",
        cylinders=options.cylinder,
        labels=options.labels,
        from_metal_mm=options.from_metal,
        figures=not options.no_figures,
    )
    lines = [f"{'region':12} {'mL':>8} {'calcium':>10} {'std':>7} {'HA':>8}  mg/mL"]
    for one in found:
        text = f"{one.name:12} {one.volume_ml:8.3f} {one.calcium_mg_ml:10.1f} {one.std_mg_ml:7.1f}"
        left = f"  ({100 * one.left_out:.0f} % too near to metal)" if one.left_out else ""
        lines.append(f"{text} {one.hydroxyapatite_mg_ml:8.1f}{left}")
    return Answer("\n".join(lines), {"regions": [vars(one) for one in found]})

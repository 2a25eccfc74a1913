"""A geometry's file from one format into another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from torchkcreg.geometry import gantry_about_z
from torchkcreg.io import read_geometry, write_geometry


def convert_geometry(
    source: Path,
    target: Path,
    *,
    projections: Path | None = None,
    det_shape: Sequence[int] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layout: str | None = None,
    gantry_axis: str = "z",
    overwrite: bool = False,
) -> str:
    """Writes the geometry of one file to another, whose ending says the format; returns what was done, for people.

    Args:
        source: see `read_geometry`.
        target: JSON, XML, NPY, NPZ, CSV or TXT.
        projections: image whose header says what the pixels are.
        det_shape: (rows, cols), where no header says it.
        pixel_spacing: (dv, du) in mm, or one number for both.
        layout: of twelve numbers a view, read or written.
        gantry_axis: of the source's world; where it is not z, the world is turned, `gantry_about_z`.
        overwrite: replace the target.

    Raises:
        FileExistsError: the target is there.
        ValueError: see `read_geometry`; or more than two pixel pitches.
    """
    if target.exists() and not overwrite:
        raise FileExistsError(f"{target} is there already: name another file, or overwrite it")
    if pixel_spacing is not None and len(pixel_spacing) not in (1, 2):
        raise ValueError(f"pixel pitch must be one number or two, got {len(pixel_spacing)}")
    spacing = None if pixel_spacing is None else [pixel_spacing[0], pixel_spacing[-1]]
    geometry = read_geometry(source, projections=projections, det_shape=det_shape, pixel_spacing=spacing, layout=layout)
    turned = ""
    if gantry_axis != "z":
        geometry = geometry.moved(torch.linalg.inv(gantry_about_z(gantry_axis)))
        axes = {"y": "x, y, z of the new world are z, x, y of the old one", "x": "x, y, z of the new world are y, z, x"}
        turned = f"; {axes[gantry_axis]}"
    write_geometry(target, geometry, layout=layout or "matrices")
    rows, cols = geometry.det_shape
    return f"{geometry.num_views} views of {rows} x {cols} pixels: {target}{turned}"

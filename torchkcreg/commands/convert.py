"""Files of one format into another: geometries, meshes, projections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from torchkcreg.geometry import gantry_about_z
from torchkcreg.io import (
    WRITTEN_SUFFIXES,
    read_geometry,
    read_mesh,
    read_projections,
    write_geometry,
    write_mesh,
    write_stack,
)

IMAGE_SUFFIXES = (".mha", ".nrrd", ".nii", ".nii.gz")
GEOMETRY_SUFFIXES = (".json", ".xml", ".npy", ".npz", ".csv", ".txt")


def convert(
    source: Path,
    target: Path,
    *,
    projections: Path | None = None,
    det_shape: Sequence[int] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layout: str | None = None,
    gantry_axis: str = "z",
    open_beam: float | None = None,
    overwrite: bool = False,
) -> str:
    """Writes what one file holds to another, whose ending says the format; returns what was done, for people.

    A target that ends as a mesh takes the source for one, a target that ends as an image (MHA, NRRD, NIfTI) takes it
    for projections and holds their line integrals, NaN where a pixel does not count; all others are geometries.

    Args:
        source: see `read_geometry`, `read_mesh`, `read_projections`.
        target: JSON, XML, NPY, NPZ, CSV or TXT; STL, OBJ, PLY or OFF; MHA, NRRD or NIfTI.
        projections: image whose header says what a geometry's pixels are.
        det_shape: (rows, cols), where no header says it.
        pixel_spacing: (dv, du) in mm, or one number for both; also of the images that are written.
        layout: of twelve numbers a view, read or written.
        gantry_axis: of the source's world; where it is not z, the world is turned, `gantry_about_z`.
        open_beam: of projections, where their file does not say it.
        overwrite: replace the target.

    Raises:
        FileExistsError: the target is there.
        ValueError: see the readers; or more than two pixel pitches.
    """
    if target.exists() and not overwrite:
        raise FileExistsError(f"{target} is there already: name another file, or overwrite it")
    if pixel_spacing is not None and len(pixel_spacing) not in (1, 2):
        raise ValueError(f"pixel pitch must be one number or two, got {len(pixel_spacing)}")
    spacing = None if pixel_spacing is None else (pixel_spacing[0], pixel_spacing[-1])
    if target.suffix.lower() in WRITTEN_SUFFIXES:
        mesh = read_mesh(source)
        write_mesh(target, mesh)
        return f"{len(mesh.faces)} triangles, {' x '.join(f'{size:.4g}' for size in mesh.extents)} mm: {target}"
    if target.name.lower().endswith(IMAGE_SUFFIXES):
        found = read_projections(source, open_beam=open_beam)
        lines = torch.where(found.mask, found.line_integrals, torch.nan)
        write_stack(target, lines, spacing or (found.header.spacing if found.header else None))
        left = f"; {note}" if (note := found.masked_note()) else ""
        return f"line integrals of {len(lines)} views of {lines.shape[1]} x {lines.shape[2]} pixels: {target}{left}"
    if target.suffix.lower() not in GEOMETRY_SUFFIXES or source.name.lower().endswith(IMAGE_SUFFIXES):
        kinds = (("geometries", GEOMETRY_SUFFIXES), ("meshes", WRITTEN_SUFFIXES), ("line integrals", IMAGE_SUFFIXES))
        known = "; ".join(f"{what} as {', '.join(suffixes)}" for what, suffixes in kinds)
        raise ValueError(f"{source.name} is not written as {target.name}: {known}")
    geometry = read_geometry(source, projections=projections, det_shape=det_shape, pixel_spacing=spacing, layout=layout)
    turned = ""
    if gantry_axis != "z":
        geometry = geometry.moved(torch.linalg.inv(gantry_about_z(gantry_axis)))
        axes = {"y": "x, y, z of the new world are z, x, y of the old one", "x": "x, y, z of the new world are y, z, x"}
        turned = f"; {axes[gantry_axis]}"
    write_geometry(target, geometry, layout=layout or "matrices")
    rows, cols = geometry.det_shape
    return f"{geometry.num_views} views of {rows} x {cols} pixels: {target}{turned}"

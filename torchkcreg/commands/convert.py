"""Convert geometries, meshes and projections between file formats."""

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
    """Convert a file to the format given by the target's suffix; return a one-line summary.

    If the target is a mesh, the source is read as a mesh. If the target is an image (MHA, NRRD, NIfTI), the source is
    read as projections, and their line integrals are written, with NaN in masked pixels; spacing and origin of the
    source's header are kept. Otherwise both are geometries.

    Args:
        source: See `read_geometry`, `read_mesh`, `read_projections`.
        target: JSON, XML, NPY, NPZ, CSV or TXT; STL, OBJ, PLY or OFF; MHA, NRRD or NIfTI.
        projections: Image whose header gives number and size of a geometry's pixels.
        det_shape: Detector size (rows, cols), if no header gives it.
        pixel_spacing: (dv, du) in mm, or one number for both; also used for images that are written.
        layout: Meaning of twelve numbers per view, read or written: "matrices" or "astra".
        gantry_axis: Rotation axis in the source's world; if it is not z, the world is rotated (`gantry_about_z`).
        open_beam: Unattenuated intensity of projections, if their file does not give it.
        overwrite: Replace the target if it exists.

    Raises:
        FileExistsError: If the target exists.
        ValueError: If a file cannot be read, or more than two pixel pitches are given.
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
        stack = read_projections(source, open_beam=open_beam)
        lines = torch.where(stack.mask, stack.line_integrals, torch.nan)
        kept = (stack.header.spacing, stack.header.origin_mm) if stack.header else (None, None)
        write_stack(target, lines, spacing or kept[0], kept[1])
        masked = f"; {note}" if (note := stack.masked_note()) else ""
        return f"line integrals of {len(lines)} views of {lines.shape[1]} x {lines.shape[2]} pixels: {target}{masked}"
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

"""Map points from the undeformed implant's frame to the world."""

from __future__ import annotations

import warnings
from pathlib import Path

from torch import Tensor

from torchkcreg.io import read_points, read_run, write_points


def warp_files(
    run_folder: Path,
    points_file: Path,
    out: Path,
    *,
    implant_name: str | None = None,
    overwrite: bool = False,
) -> Tensor:
    """Write the points in the world, mm, with expected errors; return a mask (N,) of points beyond the implant's reach.

    Args:
        run_folder: Folder of a finished registration.
        points_file: Table of x, y, z in the undeformed implant's frame, mm.
        out: Table to write: x, y, z in the world, `outside`, and `lateral_std_mm`, `depth_std_mm` if the run has them.
        implant_name: Name of the implant to which the points belong, if the run has several.
        overwrite: Replace the table if it exists; the points themselves are never replaced.

    Raises:
        FileExistsError: If the table exists, or is the file of the points.
        ValueError: If the run has no implant of that name, or a file cannot be read.
    """
    if out.exists() and out.samefile(points_file):
        raise FileExistsError(f"{out} holds the points themselves: name another file to write")
    if out.exists() and not overwrite:
        raise FileExistsError(f"{out} is there already: name another file, or overwrite it")
    result, points = read_run(run_folder), read_points(points_file)
    try:
        implant = result.implant(implant_name)
    except ValueError as error:
        raise ValueError(f"run folder {run_folder}: {error}") from None
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
    write_points(out, implant.warp(points), **columns)
    return outside

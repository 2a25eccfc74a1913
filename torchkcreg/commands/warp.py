"""Map points from the undeformed implant's frame to the world."""

from __future__ import annotations

import warnings
from pathlib import Path

from torch import Tensor

from torchkcreg.io import implant_of_run, is_points_table, read_points, write_points

FLAG = "outside"  # column of the points beyond the implant's reach


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
        overwrite: Replace any file. Without it only a table that this command wrote is replaced; the points themselves
            never are.

    Raises:
        FileExistsError: If the table would replace another file, or the points.
        ValueError: If the run has no implant of that name, or a file cannot be read.
    """
    points = read_points(points_file)
    if out.exists() and out.samefile(points_file):
        raise FileExistsError(f"{out} holds the points themselves: name another file to write")
    if out.exists() and not overwrite and not is_points_table(out, FLAG):
        raise FileExistsError(
            f"{out} is there already and no table of warped points: name another file, or overwrite it"
        )
    _, implant = implant_of_run(run_folder, implant_name)
    outside = implant.outside(points)
    if outside.any():
        warnings.warn(
            f"{int(outside.sum())} of {len(points)} points lie beyond the implant's reach: "
            "they move rigidly with its nearest part",
            stacklevel=1,
        )
    columns = {FLAG: outside}
    if implant.deviations is not None:
        columns |= dict(zip(("lateral_std_mm", "depth_std_mm"), implant.deviations.split(points), strict=True))
    write_points(out, implant.warp(points), **columns)
    return outside

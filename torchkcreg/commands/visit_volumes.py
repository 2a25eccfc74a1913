"""Volumes of a visit's unloaded scan, by FDK and by KC-Rec, and bone mineral in regions that the implant shows."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from torch import Tensor

from torchkcreg.evaluation import MineralContent
from torchkcreg.geometry import transform_points
from torchkcreg.implant import Screw
from torchkcreg.plain import first_line
from torchkcreg.registration import RegisteredImplant

from .densitometry import densitometry_files
from .reconstruct import reconstruct_files
from .reconstruct_options import ReconstructionFiles, ReconstructionOptions

FEWEST_VIEWS = 60  # of a scan: with fewer, streaks are all that a volume shows
_GAP_MM = 3.0  # half the length of the region in the gap
_AROUND_SCREW_MM = 4.0
_UNDER_MM, _UNDER_RADIUS_MM = 15.0, 2.5  # half length and radius of the region under the implant
METHODS = ("fdk", "kcrec")


def regions_of(first: RegisteredImplant, nodes: Tensor, places: Tensor, axis: Tensor) -> dict[str, list[float]]:
    """Cylinders in the world, seven numbers each (both ends of the axis and the radius, mm), by their names.

    Args:
        first: The registered implant.
        nodes: Its undeformed nodes (N, 3).
        places: Near cortex, bone axis and far cortex at the gap (3, 3), in the implant's frame.
        axis: The implant's long axis (3,) in the world.
    """
    near, middle, far = first.warp(places)
    down = (far - near) / (far - near).norm()
    under = near + _UNDER_RADIUS_MM * down
    regions = {
        "gap": _cylinder(middle - _GAP_MM * axis, middle + _GAP_MM * axis, 0.5 * float((far - near).norm())),
        "under the implant": _cylinder(under - _UNDER_MM * axis, under + _UNDER_MM * axis, _UNDER_RADIUS_MM),
    }
    for screw in first.screws:
        regions[f"around {screw.name}"] = _around(first, screw, nodes)
    return regions


def _cylinder(start: Tensor, end: Tensor, radius: float) -> list[float]:
    return [*start.tolist(), *end.tolist(), radius]


def _around(first: RegisteredImplant, screw: Screw, nodes: Tensor) -> list[float]:
    ends = nodes.new_tensor([screw.start, screw.end])
    head, tip = transform_points(first.motion_of(screw, nodes), ends)
    return _cylinder(
        head + (tip - head) / 4, tip, screw.radius + _AROUND_SCREW_MM
    )  # the first quarter is the implant's


def volumes_of(
    run: Path,
    out: Path,
    regions: dict[str, list[float]],
    *,
    spacing_mm: float,
    resume: bool,
    overwrite: bool,
    figures: bool,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Reconstruct the scan of a run by FDK and KC-Rec into `out`, and measure bone mineral in regions of the latter.

    Returns:
        The mineral of each region, and reasons why something is missing.

    Args:
        run: Folder of the unloaded registration.
        out: Folder for `fdk`, `kcrec` and `densitometry`.
        regions: Cylinders of seven numbers by their names.
        spacing_mm: Voxel size.
        resume: Keep finished volumes, continue an interrupted one.
        overwrite: Replace existing volumes.
        figures: Draw figures and reports.
    """
    doubts: list[str] = []
    for method in METHODS:
        folder = out / method
        if resume and (folder / "volume.mha").exists() and (folder / "metrics.json").exists():
            continue
        options = ReconstructionOptions.of({"method": method, "spacing_mm": spacing_mm}, "options")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # doubts about the run, which the answer gives
                going_on = resume and (folder / "config.yaml").exists()
                files = ReconstructionFiles(run=run)
                reconstruct_files(files, folder, options, overwrite=overwrite, resume=going_on, figures=figures)
        except (ValueError, OSError, RuntimeError) as error:
            doubts.append(f"no volume by {method}: {first_line(error)}")
    if not (out / "kcrec" / "volume.mha").exists():
        return [], doubts
    try:
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always", UserWarning)
            found = densitometry_files(
                out / "kcrec", out / "densitometry", cylinders=list(regions.values()), figures=figures
            )
    except (ValueError, OSError) as error:
        return [], [*doubts, f"no bone mineral: {first_line(error)}"]
    names = {f"cylinder {number}": name for number, name in enumerate(regions, 1)}
    for note in notes:
        text = str(note.message)
        number, _, rest = text.partition(":")
        doubts.append(f"region {names[number]}:{rest}" if number in names else text)
    return [_mineral(content, names[content.name], regions) for content in found], doubts


def _mineral(content: MineralContent, name: str, regions: dict[str, list[float]]) -> dict[str, Any]:
    return {
        "region": name,
        "cylinder_mm": list(regions[name]),
        "hydroxyapatite_mg_ml": content.hydroxyapatite_mg_ml,
        "std_over_voxels_mg_ml": content.std_mg_ml,
        "volume_ml": content.volume_ml,
        "left_out": content.left_out,
    }

"""Bone mineral density near an implant, from the folder of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchkcreg.evaluation import MineralContent, cylinder_region, distance_to, mineral_content
from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_json, read_volume, write_figure, write_json
from torchkcreg.physics import calcium_of
from torchkcreg.visualization import reconstruction_figure

_METAL = 0.05  # a voxel is metal if the implant adds more than this fraction of its largest added attenuation


def densitometry_files(
    reconstruction: Path,
    out: Path,
    *,
    cylinders: Sequence[Sequence[float]] = (),
    labels: Path | None = None,
    from_metal_mm: float = 1.5,
    figures: bool = True,
) -> list[MineralContent]:
    """Measure calcium in regions of a reconstruction; write `densitometry.json` and `densitometry.png` to `out`.

    Args:
        reconstruction: Folder of a reconstruction by any method; the metal is most accurate with `kcrec`.
        out: Output folder, created if missing.
        cylinders: Cylindrical regions, seven numbers each: both ends of the axis (x, y, z) and the radius, mm.
        labels: Label map on the reconstruction's voxels, such as a segmentation: each label above zero is a region.
        from_metal_mm: Voxels closer to metal than this are ignored.
        figures: Draw the regions.

    Raises:
        ValueError: If no region is given, a region does not fit, or the reconstruction has no reference energy.
        FileNotFoundError: If a file is missing.
    """
    volume, grid = read_volume(reconstruction / "volume.mha")
    metrics = read_json(reconstruction / "metrics.json", "metrics")
    energy = metrics.get("reference_kev") if isinstance(metrics, dict) else None
    if energy is None:
        raise ValueError(f"reconstruction {reconstruction} has no reference energy: make it with a spectrum")
    regions = {**_cylinders(cylinders, grid), **_labelled(labels, grid)}
    if not regions:
        raise ValueError("densitometry needs regions: cylinders, or a label map")
    if from_metal_mm < 0:
        raise ValueError(f"from_metal_mm must not be negative, got {from_metal_mm}")
    metal = _metal(reconstruction, volume)
    usable = distance_to(metal, grid) >= max(from_metal_mm, 1e-9)
    calcium = calcium_of(volume, float(energy))
    contents = mineral_content(calcium, regions, grid, usable=usable)
    out.mkdir(parents=True, exist_ok=True)
    record = {
        "units": {"calcium": "mg/mL", "hydroxyapatite": "mg/mL", "content": "mg of hydroxyapatite", "volume": "mL"},
        "reference_kev": energy,
        "from_metal_mm": from_metal_mm,
        "regions": [_record(content) for content in contents],
    }
    write_json(out / "densitometry.json", record)
    if figures:
        inside = torch.stack([(region.bool() & usable) for region in regions.values()]).any(0)
        heights = grid.origin[2] + grid.spacing[2] * inside.any(dim=(1, 2)).nonzero().float().mean()
        figure = reconstruction_figure(
            {"calcium, mg/mL": calcium.masked_fill(metal, 0.0)},
            grid,
            heights_mm=(float(heights),),
            window=(-50.0, 300.0),
            metal=inside.float(),
            unit="mg/mL",
        )
        write_figure(out / "densitometry.png", figure)
    return contents


def _record(content: MineralContent) -> dict[str, float | str | int]:
    return {**vars(content), "hydroxyapatite_mg_ml": content.hydroxyapatite_mg_ml, "content_mg": content.content_mg}


def _metal(reconstruction: Path, volume: Tensor) -> Tensor:
    """Mask of metal voxels (D, H, W); all False if the reconstruction had no known metal."""
    path = reconstruction / "with_implant.mha"
    if not path.exists():
        return torch.zeros_like(volume, dtype=torch.bool)
    added = read_volume(path)[0] - volume
    return added > _METAL * added.max().clamp_min(1e-9)


def _cylinders(cylinders: Sequence[Sequence[float]], grid: VolumeGrid) -> dict[str, Tensor]:
    regions = {}
    for number, cylinder in enumerate(cylinders, 1):
        if len(cylinder) != 7:
            raise ValueError(f"a cylinder is seven numbers, two ends (x, y, z) and a radius, got {len(cylinder)}")
        regions[f"cylinder {number}"] = cylinder_region(grid, cylinder[:3], cylinder[3:6], cylinder[6])
    return regions


def _labelled(path: Path | None, grid: VolumeGrid) -> dict[str, Tensor]:
    if path is None:
        return {}
    labels, its_grid = read_volume(path)
    if labels.shape != tuple(grid.shape) or not its_grid.lies_on(grid):
        raise ValueError(f"label map {path} must lie on the reconstruction's voxels: resample it there")
    numbers = [int(n) for n in labels.unique().tolist() if n > 0]
    if bool((labels != labels.round()).any()) or not numbers:
        raise ValueError(f"label map {path} must hold whole numbers, and some above zero")
    return {f"label {n}": labels == n for n in numbers}

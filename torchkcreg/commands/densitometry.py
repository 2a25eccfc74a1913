"""Bone mineral density near an implant, from the folder of a reconstruction."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchkcreg.evaluation import MineralContent, cylinder_region, distance_to, mineral_content
from torchkcreg.geometry import VolumeGrid, transform_points
from torchkcreg.io import read_json, read_volume, write_figure, write_json
from torchkcreg.physics import calcium_of
from torchkcreg.visualization import reconstruction_figure

_NO_BONE_MG_ML = 900.0  # cortical bone has 450, enamel 1100
_ROUNDED = 0.1  # a cylinder's voxels may add up to so much less than its volume
_OFF_VOXEL = 0.01  # of a voxel
_NOTICEABLE = 0.005
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

    Parts of a region beyond the volume, not seen from all sides, or near metal are left out, with a warning.

    Args:
        reconstruction: Folder of a reconstruction by any method; the metal is most accurate with `kcrec`.
        out: Output folder, created if missing.
        cylinders: Cylindrical regions, seven numbers each: both ends of the axis (x, y, z) and the radius, mm.
        labels: Label map on the reconstruction's voxels, such as a segmentation: each label above zero is a region.
        from_metal_mm: Voxels closer to metal than this are ignored. If the reconstruction knows of no metal, voxels
            that are too dense for bone count as metal.
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
    calcium = calcium_of(volume, float(energy))
    metal = _metal(reconstruction, volume, calcium)
    apart = distance_to(metal, grid) >= max(from_metal_mm, 1e-9)
    seen = _seen(reconstruction, grid)
    usable = apart & seen
    beyond = [_beyond(*pair, grid) for pair in zip(cylinders, regions.values(), strict=False)]  # cylinders come first
    beyond += [0.0] * (len(regions) - len(cylinders))
    contents = [
        replace(content, left_out=_left_out(content, regions[content.name], voxels, apart, seen))
        for content, voxels in zip(mineral_content(calcium, regions, grid, usable=usable), beyond, strict=True)
    ]
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


def _beyond(cylinder: Sequence[float], region: Tensor, grid: VolumeGrid) -> float:
    """Number of voxels by which a cylinder reaches beyond the volume; 0 if its voxels are only rounded."""
    ends = torch.tensor([cylinder[:3], cylinder[3:6]], dtype=torch.float64)
    whole = math.pi * cylinder[6] ** 2 * float((ends[1] - ends[0]).norm()) / grid.voxel_volume
    inside = float(region.sum())
    return whole - inside if whole > (1 + _ROUNDED) * inside else 0.0


def _left_out(content: MineralContent, region: Tensor, beyond: float, apart: Tensor, seen: Tensor) -> float:
    """Share of a region that is not measured; a warning says why."""
    whole = float(region.sum()) + beyond
    reasons = {
        "lies beyond the volume": beyond / whole,
        "is not seen from all sides": float((region.bool() & ~seen).sum()) / whole,
        "is metal or too near to it": float((region.bool() & seen & ~apart).sum()) / whole,
    }
    if stated := [f"{100 * share:.0f} % {reason}" for reason, share in reasons.items() if share >= _NOTICEABLE]:
        warnings.warn(f"{content.name}: {', '.join(stated)} and is left out", stacklevel=3)
    return 1 - content.num_voxels / whole


def _seen(reconstruction: Path, grid: VolumeGrid) -> Tensor:
    """Mask of voxels (D, H, W) that are seen from all sides; all True with a warning if the folder does not tell."""
    path = reconstruction / "measured.mha"
    if path.exists():
        return read_volume(path)[0] > 0.5
    warnings.warn(f"folder {reconstruction} does not tell which voxels were measured: reconstruct again", stacklevel=3)
    return torch.ones(tuple(grid.shape), dtype=torch.bool)


def _metal(reconstruction: Path, volume: Tensor, calcium: Tensor) -> Tensor:
    """Mask of metal voxels (D, H, W): the known metal, or what no bone can be if the reconstruction knew of none."""
    path = reconstruction / "with_implant.mha"
    if not path.exists():
        dense = calcium > _NO_BONE_MG_ML
        if bool(dense.any()):
            warnings.warn(
                f"the reconstruction knows of no metal: voxels of more than {_NO_BONE_MG_ML:.0f} mg/mL of calcium are "
                "taken for metal; its streaks remain. Reconstruct with --method kcrec",
                stacklevel=3,
            )
        return dense
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
    numbers = [int(n) for n in labels.unique().tolist() if n > 0]
    if bool((labels != labels.round()).any()) or not numbers:
        raise ValueError(f"label map {path} must hold whole numbers, and some above zero")
    placed = _placed(labels, its_grid, grid)
    if placed is None:
        raise ValueError(f"label map {path} must lie on the reconstruction's voxels: resample it there")
    absent = [n for n in numbers if not bool((placed == n).any())]
    if absent:
        raise ValueError(f"label map {path}: label {absent[0]} lies outside the reconstruction")
    return {f"label {n}": placed == n for n in numbers}


def _placed(labels: Tensor, its_grid: VolumeGrid, grid: VolumeGrid) -> Tensor | None:
    """Labels on the voxels of a grid, from the same voxels cropped, turned or in another order; None if from others."""
    index = labels.nonzero()
    points = transform_points(its_grid.voxel_to_world.double(), index.flip(-1).double())
    places = transform_points(grid.world_to_voxel.double(), points)
    same_size = abs(its_grid.voxel_volume - grid.voxel_volume) < 1e-3 * grid.voxel_volume
    if not same_size or bool(((places - places.round()).abs() > _OFF_VOXEL).any()):
        return None
    place = places.round().long().flip(-1)
    inside = ((place >= 0) & (place < torch.tensor(grid.shape))).all(-1)
    if not bool(inside.all()):
        share = float((~inside).double().mean())
        warnings.warn(f"{100 * share:.0f} % of the label map's regions lie beyond the volume", stacklevel=4)
    placed = torch.zeros(tuple(grid.shape), dtype=labels.dtype)
    placed[tuple(place[inside].T)] = labels[tuple(index[inside].T)]
    return placed

"""Bone mineral in regions of a reconstructed volume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

CALCIUM_IN_HYDROXYAPATITE = 0.3989  # by mass, of Ca10(PO4)6(OH)2


@dataclass(frozen=True)
class MineralContent:
    """Bone mineral of a region.

    Attributes:
        name: Name of the region.
        num_voxels: Number of voxels measured: the usable ones, such as those far enough from metal.
        left_out: Share of the region's voxels that are excluded.
        volume_ml: Volume of the measured voxels.
        calcium_mg_ml: Mean concentration of calcium.
        std_mg_ml: Standard deviation of the concentration over the voxels.
    """

    name: str
    num_voxels: int
    left_out: float
    volume_ml: float
    calcium_mg_ml: float
    std_mg_ml: float

    @property
    def hydroxyapatite_mg_ml(self) -> float:
        """Mean concentration as hydroxyapatite, the unit in which bone phantoms and scanners are calibrated."""
        return self.calcium_mg_ml / CALCIUM_IN_HYDROXYAPATITE

    @property
    def content_mg(self) -> float:
        """Mass of hydroxyapatite in the measured volume."""
        return self.hydroxyapatite_mg_ml * self.volume_ml


def mineral_content(
    calcium_mg_ml: Tensor, regions: Mapping[str, Tensor], grid: VolumeGrid, *, usable: Tensor | None = None
) -> list[MineralContent]:
    """Bone mineral of each region.

    Args:
        calcium_mg_ml: Concentration of calcium (D, H, W).
        regions: Masks (D, H, W) by name, true inside the region.
        grid: Voxels of the volume.
        usable: True for voxels to measure, such as those far enough from metal; all if None.

    Raises:
        ValueError: If shapes differ, or a region has fewer than two usable voxels.
    """
    contents = []
    for name, region in regions.items():
        if region.shape != calcium_mg_ml.shape or tuple(region.shape) != tuple(grid.shape):
            raise ValueError(
                f"region {name} must have the volume's shape {tuple(grid.shape)}, got {tuple(region.shape)}"
            )
        whole = region.bool()
        counted = whole if usable is None else whole & usable
        values = calcium_mg_ml[counted].double()
        if len(values) < 2:
            raise ValueError(f"region {name} has {len(values)} usable voxels of {int(whole.sum())}, too few to measure")
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"region {name} holds values that are not finite")
        contents.append(
            MineralContent(
                name,
                len(values),
                1 - len(values) / int(whole.sum()),
                len(values) * grid.voxel_volume / 1000,
                float(values.mean()),
                float(values.std()),
            )
        )
    return contents

"""What an iterative reconstruction gives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed volume.

    Attributes:
        volume: attenuation (D, H, W), 1/mm.
        history: one record an iteration: iteration, subsets, objective (exact where asked for, else None), estimate
            (the objective with each subset's residual as it was met), change (RMS over the voxels, 1/mm), seconds.
    """

    volume: Tensor
    history: list[dict[str, Any]] = field(default_factory=list)

"""Candidate states of a scene: positions of implants and components, and parameters of the intensity model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class Placement:
    """Positions of an implant and its components in K candidates.

    Attributes:
        nodes: World positions (K, N, 3) of the implant's nodes, mm.
        components: Motions (K, C, 4, 4) of its components from the implant's frame to the world.
    """

    nodes: Tensor
    components: Tensor


@dataclass(frozen=True)
class State:
    """K candidate states of a scene.

    Attributes:
        placements: Placement of each assembly, in the scene's order.
        physics: Arguments of the intensity model, each of shape (K,), the blur in rendered pixels.
        added: Path lengths (K, V, rows, cols) added to a material, by its name, mm.
        views: Motions (K, V, 4, 4) of the world before it is projected in each view; none when None.
    """

    placements: tuple[Placement, ...]
    physics: Mapping[str, Tensor] = field(default_factory=dict)
    added: Mapping[str, Tensor] = field(default_factory=dict)
    views: Tensor | None = None

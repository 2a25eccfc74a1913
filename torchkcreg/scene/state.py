"""What a rendered picture depends on: where implants and components are, and the parameters of the intensity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class Placement:
    """Where K candidates have an implant and what is fixed to it.

    Attributes:
        nodes: World positions (K, N, 3) of the implant's nodes, mm.
        components: Motions (K, C, 4, 4) of its components from the implant's frame to the world.
    """

    nodes: Tensor
    components: Tensor


@dataclass(frozen=True)
class State:
    """K candidates of a scene.

    Attributes:
        placements: Of each assembly, in the scene's order.
        physics: Arguments of the intensity model, each of shape (K,), the blur in the rendered pixels.
        added: What is added to the path lengths of a material, by its name, (K, V, rows, cols), mm.
        views: Motions (K, V, 4, 4) of the world before it is projected in each view; none when None.
    """

    placements: tuple[Placement, ...]
    physics: Mapping[str, Tensor] = field(default_factory=dict)
    added: Mapping[str, Tensor] = field(default_factory=dict)
    views: Tensor | None = None

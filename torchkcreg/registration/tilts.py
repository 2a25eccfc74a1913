"""How components turn about their heads, beside following the implant: the deformation is smoother than a plate is."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchkcreg.geometry import across, rotation_about

from .scene import Scene

_LIKELY_DEG = 1.0  # of a component whose direction was told
_LIKELY_FOUND_DEG = 3.0  # of a screw that was found along its hole


class ComponentTilts:
    """Rotations of components about their heads, as millimetres at their far ends.

    A screw is long: what the smooth deformation makes of a plate's rotation at its hole, a tenth of a degree off, moves
    its tip by more than the plate's own error. With its direction fixed to the plate the long edges of its image would
    bend the plate.

    Args:
        scene: With its components and how they are tilted so far.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, components = scene, scene.components
        axes = [c.axis.double() for c in components]
        self.lengths = torch.stack(
            [((c.cloud.points.double() - c.head) @ axis).amax() for c, axis in zip(components, axes, strict=True)]
        ).clamp_min(1.0)
        self.across = torch.stack([across(axis) for axis in axes])
        self.likely = math.radians(_LIKELY_FOUND_DEG if scene.found else _LIKELY_DEG)

    @property
    def num_parameters(self) -> int:
        """Two a component."""
        return 2 * len(self.lengths)

    def vectors(self, parameters: Tensor) -> Tensor:
        """Rotation vectors (K, C, 3) in the implant's frame after steps (K, 2 C), mm at the far ends."""
        steps = parameters.unflatten(-1, (-1, 2)) / self.lengths[:, None]
        return self.scene.tilts + (steps[..., None] * self.across).sum(-2)

    def motions(self, parameters: Tensor) -> Tensor:
        """Rigid motions (K, C, 4, 4) in the implant's frame."""
        return rotation_about(self.scene.heads, self.vectors(parameters))

    def penalty(self, parameters: Tensor) -> Tensor:
        """Squared tilts (K,) in standard deviations, summed."""
        return (self.vectors(parameters) / self.likely).square().sum((-2, -1))

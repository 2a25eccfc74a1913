"""How components turn about their heads, beside following the implant: the deformation is smoother than a plate is."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchkcreg.geometry import across, rigid_matrix, rotation_about
from torchkcreg.parameters import ParameterBlock

from .assembly import Assembly

_LIKELY_DEG = 1.0  # of a component whose direction was told
_LIKELY_FOUND_DEG = 3.0  # of a screw that was found along its hole
_LIKELY_SHIFT_MM = 0.2  # of a found screw's head: a hole is that much wider than the screw


class ComponentTilts(ParameterBlock):
    """Rotations of components about their heads, as millimetres at their far ends, and shifts of found screws' heads.

    A screw is long: what the smooth deformation makes of a plate's rotation at its hole, a tenth of a degree off, moves
    its tip by more than the plate's own error. With its direction fixed to the plate the long edges of its image would
    bend the plate. A screw that was found may besides sit anywhere in its hole, which is wider than it.

    Args:
        assembly: With its components and how they are tilted so far.
        weight: Loss for a tilt or shift of a standard deviation.
    """

    def __init__(self, assembly: Assembly, weight: float) -> None:
        self.assembly, self.weight, components = assembly, weight, list(assembly.components)
        axes = [c.axis.double() for c in components]
        self.lengths = torch.stack(
            [((c.cloud.points.double() - c.head) @ axis).amax() for c, axis in zip(components, axes, strict=True)]
        ).clamp_min(1.0)
        self.across = torch.stack([across(axis) for axis in axes])
        self.shift = bool(assembly.found)
        self.likely = math.radians(_LIKELY_FOUND_DEG if assembly.found else _LIKELY_DEG)
        self.num_parameters = (4 if self.shift else 2) * len(components)  # four, where heads shift

    def vectors(self, steps: Tensor) -> Tensor:
        """Rotation vectors (K, C, 3) in the implant's frame after steps (K, D), mm at the far ends."""
        angles = steps[..., : 2 * len(self.lengths)].unflatten(-1, (-1, 2)) / self.lengths[:, None]
        return self.assembly.tilts + (angles[..., None] * self.across).sum(-2)

    def shifts(self, steps: Tensor) -> Tensor:
        """How far the heads move across the axes after steps (K, D), shape (K, C, 3), mm in the implant's frame."""
        if not self.shift:
            return steps.new_zeros(*steps.shape[:-1], len(self.lengths), 3)
        lengths = steps[..., 2 * len(self.lengths) :].unflatten(-1, (-1, 2))
        return (lengths[..., None] * self.across).sum(-2)

    def motions(self, steps: Tensor) -> Tensor:
        """Rigid motions (K, C, 4, 4) in the implant's frame."""
        turns = rotation_about(self.assembly.heads, self.vectors(steps))
        return rigid_matrix(torch.zeros_like(self.assembly.heads), self.shifts(steps)) @ turns

    def penalty(self, steps: Tensor) -> Tensor:
        """Squared tilts and shifts (K,) in standard deviations, weighted."""
        tilts, shifts = self.vectors(steps) / self.likely, self.shifts(steps) / _LIKELY_SHIFT_MM
        return self.weight * (tilts.square().sum((-2, -1)) + shifts.square().sum((-2, -1)))

"""A screw that was found, and how its image changes with its length and radius."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchkcreg.implant import Component

_LENGTH_STEP_MM = 0.5
_RADIUS_STEP_MM = 0.05
_RADIUS_UNIT_MM = 0.2  # a unit step in radius changes an image about as much as one in length
_LARGEST_STEPS_MM = (4.0, 0.4)  # of length and radius in one stage


@dataclass(frozen=True)
class FoundScrew:
    """A cylinder in the implant's frame, mm.

    Attributes:
        start: Centre (x, y, z) of its head's end, in the hole's opening.
        end: Its tip.
        radius: Of its shaft.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    @property
    def length(self) -> float:
        """From start to end, mm."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def with_length(self, length: float) -> FoundScrew:
        """The screw with its tip elsewhere along its axis."""
        axis = np.subtract(self.end, self.start) / self.length
        x, y, z = np.add(self.start, length * axis).tolist()
        return replace(self, end=(x, y, z))

    def with_radius(self, radius: float) -> FoundScrew:
        """The screw, thicker or thinner."""
        return replace(self, radius=radius)

    def overlaps(self, other: FoundScrew) -> bool:
        """Whether two screws share a hole or, side by side in a combination hole, run into each other."""
        way = np.subtract(self.start, other.start)
        axis = np.subtract(other.end, other.start) / other.length
        return float(np.linalg.norm(way - (way @ axis) * axis)) < self.radius + other.radius

    def component(self, name: str, material: str, pitch: float) -> Component:
        """The screw's nodes, ``pitch`` mm apart."""
        return Component.screw(name, self.start, self.end, self.radius, material=material, pitch=pitch)


class ScrewShapes:
    """Lengths of found screws and their common radius as parameters in mm, linear in the images.

    Args:
        screws: The screws.
        render: Path lengths (..., V, rows, cols) of a screw where it now is, tilted by a rotation vector (3,).
        tilts: The screws' tilts, shape (n, 3).
    """

    def __init__(
        self, screws: Sequence[FoundScrew], render: Callable[[FoundScrew, Tensor], Tensor], tilts: Tensor
    ) -> None:
        self.screws = list(screws)
        tilted = list(zip(self.screws, tilts, strict=True))
        longer, thicker = _LENGTH_STEP_MM, _RADIUS_STEP_MM
        slopes = [
            (render(s.with_length(s.length + longer), t) - render(s.with_length(s.length - longer), t)) / (2 * longer)
            for s, t in tilted
        ]
        swelling = [
            render(s.with_radius(s.radius + thicker), t) - render(s.with_radius(s.radius - thicker), t)
            for s, t in tilted
        ]
        slopes.append(torch.stack(swelling).sum(0) * (_RADIUS_UNIT_MM / (2 * thicker)))
        self.slopes = torch.stack(slopes)

    @property
    def num_parameters(self) -> int:
        """One length a screw, and one radius."""
        return len(self.slopes)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, S) within what the linear images hold for."""
        lengths, radius = _LARGEST_STEPS_MM
        limit = torch.full_like(steps, lengths)
        limit[..., -1] = radius / _RADIUS_UNIT_MM
        return torch.minimum(torch.maximum(steps, -limit), limit)

    def __call__(self, steps: Tensor) -> Tensor:
        """What steps (K, S) add to the path lengths, shape (K, V, rows, cols)."""
        return torch.tensordot(steps.to(self.slopes), self.slopes, dims=1)

    def stepped(self, steps: Tensor) -> list[FoundScrew]:
        """The screws after steps (S,)."""
        *lengths, radius = steps.tolist()
        return [
            s.with_length(s.length + change).with_radius(s.radius + _RADIUS_UNIT_MM * radius)
            for s, change in zip(self.screws, lengths, strict=True)
        ]

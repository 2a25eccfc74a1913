"""How the image of found screws changes with their lengths and radii."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchkcreg.implant import Screw
from torchkcreg.parameters import ParameterBlock

_LENGTH_STEP_MM = 0.5
_RADIUS_STEP_MM = 0.05
_RADIUS_UNIT_MM = 0.2  # a unit step in radius changes an image about as much as one in length
_LARGEST_STEPS = (4.0, 2.0)  # of length and radius in one stage, in units


class ScrewShapes(ParameterBlock):
    """Lengths, then radii of found screws as parameters, linear in the images.

    Args:
        screws: The screws.
        render: Path lengths (V, rows, cols) of a screw where it now is.
    """

    def __init__(self, screws: Sequence[Screw], render: Callable[[Screw], Tensor]) -> None:
        self.screws = list(screws)
        self.num_parameters = 2 * len(self.screws)
        longer, thicker = _LENGTH_STEP_MM, _RADIUS_STEP_MM
        slopes = [
            (render(s.with_length(s.length + longer)) - render(s.with_length(s.length - longer))) / (2 * longer)
            for s in self.screws
        ]
        slopes += [
            (render(s.with_radius(s.radius + thicker)) - render(s.with_radius(s.radius - thicker)))
            * (_RADIUS_UNIT_MM / (2 * thicker))
            for s in self.screws
        ]
        materials = 2 * [s.material for s in self.screws]
        self.slopes = {
            name: torch.stack([slope * (name == other) for slope, other in zip(slopes, materials, strict=True)])
            for name in dict.fromkeys(materials)
        }

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, S) within what the linear images hold for."""
        length, radius = _LARGEST_STEPS
        lengths, radii = steps.chunk(2, dim=-1)
        return torch.cat([lengths.clamp(-length, length), radii.clamp(-radius, radius)], dim=-1)

    def added(self, steps: Tensor) -> dict[str, Tensor]:
        """What steps (K, S) add to the path lengths of each material, shape (K, V, rows, cols)."""
        return {name: torch.tensordot(steps.to(slopes), slopes, dims=1) for name, slopes in self.slopes.items()}

    def stepped(self, steps: Tensor) -> list[Screw]:
        """The screws after steps (S,)."""
        return [
            s.with_length(s.length + longer).with_radius(s.radius + _RADIUS_UNIT_MM * thicker)
            for s, (longer, thicker) in zip(self.screws, steps.reshape(2, -1).T.tolist(), strict=True)
        ]

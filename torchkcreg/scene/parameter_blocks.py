"""Parameters estimated beside the motion: intensity model, component tilts, lengths and radii of found screws."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import across, rigid_matrix, rotation_about
from torchkcreg.implant import Screw
from torchkcreg.optimization.parameters import ParameterBlock
from torchkcreg.physics import IntensityModel

from .assembly import Assembly

_LIKELY_DEG = 1.0  # of a given component
_LIKELY_FOUND_DEG = 3.0  # of a screw that was found along its hole
_LIKELY_SHIFT_MM = 0.2  # of a found screw's head: a hole is that much wider than the screw
_LENGTH_STEP_MM = 0.5
_RADIUS_STEP_MM = 0.05
_RADIUS_UNIT_MM = 0.2  # a unit step in radius changes an image about as much as one in length
_LARGEST_STEPS = (4.0, 2.0)  # of length and radius in one stage, in units


class PhysicsParameters(ParameterBlock):
    """Steps of an intensity model's parameters, scaled like millimetres.

    Args:
        intensity: The model; names that it does not offer are ignored.
        names: Parameters to estimate, as `IntensityModel.free` calls them.
        pixel_px: Edge of the rendered pixels, in the detector's; the model keeps its blur in the latter.
        weight: Loss for a parameter one standard deviation from its most likely value.
    """

    def __init__(self, intensity: IntensityModel, names: Sequence[str], pixel_px: float, weight: float) -> None:
        self.intensity, self.pixel_px, self.weight = intensity, pixel_px, weight
        free = intensity.free
        self.names = [name for name in names if name in free]
        self.free = [free[name] for name in self.names]
        self.num_parameters = len(self.names)
        self.start = self._numbers(float(getattr(intensity, f.attribute).detach()) for f in self.free)
        self.scale = self._numbers(f.scale for f in self.free)
        self.low = (self._numbers(f.low for f in self.free) - self.start) / self.scale
        self.high = (self._numbers(f.high for f in self.free) - self.start) / self.scale
        self.center = self._numbers(f.likely for f in self.free)
        self.width = self._numbers(f.deviation for f in self.free)

    def on_pixels(self, pixel_px: float) -> PhysicsParameters:
        """The same parameters for rendered pixels of another size."""
        other = copy.copy(self)
        other.pixel_px = pixel_px
        return other

    def _numbers(self, values) -> Tensor:
        device = next((p.device for p in self.intensity.parameters()), None)
        return torch.tensor(list(values), dtype=torch.float64, device=device)

    def penalty(self, steps: Tensor) -> Tensor:
        """Weighted squared distances (K,) from the most likely values, in standard deviations."""
        return self.weight * ((self.values(steps) - self.center) / self.width).square().sum(-1)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) within the bounds."""
        return torch.minimum(torch.maximum(steps, self.low), self.high)

    def at_bounds(self, share: float) -> list[str]:
        """Names of parameters within this share of their range of a bound that is neither likely nor physical."""
        margin = share * (self.high - self.low)
        likely = (self.center - self.start) / self.scale
        plausible = torch.tensor([f.ends_at_low for f in self.free], dtype=torch.bool, device=self.low.device)
        near = ((self.low > -margin) & (likely > self.low) & ~plausible) | ((self.high < margin) & (likely < self.high))
        return [name for name, is_near in zip(self.names, near.tolist(), strict=True) if is_near]

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, D) of the parameters after steps."""
        return self.start + self.scale * steps

    def arguments(self, steps: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of the intensity model, each of shape (K,)."""
        values = {f.attribute: v for f, v in zip(self.free, self.values(steps).unbind(-1), strict=True)}
        arguments = self.intensity.arguments(self.pixel_px, **values)
        return {name: value.expand(len(steps)) for name, value in arguments.items()}

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Write the values after the steps into the model."""
        for free, value in zip(self.free, self.values(steps), strict=True):
            getattr(self.intensity, free.attribute).fill_(float(value))


class ComponentTilts(ParameterBlock):
    """Rotations of components about their heads, as millimetres at their far ends, and shifts of found screws' heads.

    A screw is long: an error of a tenth of a degree in the plate's rotation at its hole moves the screw's tip by more
    than the plate's own error. If its direction were fixed to the plate, the long edges of its image would bend the
    plate. The head of a found screw may also shift within its hole, which is wider than the screw.

    Args:
        assembly: Assembly with its components and their present tilts.
        weight: Loss for a tilt or shift of one standard deviation.
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
        self.num_parameters = (4 if self.shift else 2) * len(components)  # four if heads shift

    def vectors(self, steps: Tensor) -> Tensor:
        """Rotation vectors (K, C, 3) in the implant's frame after steps (K, D), mm at the far ends."""
        angles = steps[..., : 2 * len(self.lengths)].unflatten(-1, (-1, 2)) / self.lengths[:, None]
        return self.assembly.tilts + (angles[..., None] * self.across).sum(-2)

    def shifts(self, steps: Tensor) -> Tensor:
        """Shifts (K, C, 3) of the heads across the axes after steps (K, D), mm in the implant's frame."""
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


class ScrewShapes(ParameterBlock):
    """Lengths, then radii of found screws; path lengths are linearised in them.

    Args:
        screws: The screws.
        render: Gives the path lengths (V, rows, cols) of a screw at its present place.
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
            name: torch.stack([slope * (name == material) for slope, material in zip(slopes, materials, strict=True)])
            for name in dict.fromkeys(materials)
        }

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, S) limited to the range in which the linearisation holds."""
        length, radius = _LARGEST_STEPS
        lengths, radii = steps.chunk(2, dim=-1)
        return torch.cat([lengths.clamp(-length, length), radii.clamp(-radius, radius)], dim=-1)

    def added(self, steps: Tensor) -> dict[str, Tensor]:
        """Path lengths (K, V, rows, cols) that steps (K, S) add to each material."""
        return {name: torch.tensordot(steps.to(slopes), slopes, dims=1) for name, slopes in self.slopes.items()}

    def stepped(self, steps: Tensor) -> list[Screw]:
        """The screws after steps (S,)."""
        return [
            s.with_length(s.length + longer).with_radius(s.radius + _RADIUS_UNIT_MM * thicker)
            for s, (longer, thicker) in zip(self.screws, steps.reshape(2, -1).T.tolist(), strict=True)
        ]

"""Parameters of the intensity model that are estimated beside the motion."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.parameters import ParameterBlock
from torchkcreg.physics import IntensityModel


class PhysicsParameters(ParameterBlock):
    """Steps of an intensity model's parameters, scaled like millimetres.

    Args:
        intensity: The model; of the names it does not offer, none is estimated.
        names: Parameters to estimate, as :attr:`IntensityModel.free` calls them.
        pixel_px: Edge of the rendered pixels, in the detector's; the model keeps its blur in the latter.
        weight: Loss for a parameter that is a standard deviation off where it most likely is.
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
        """The same for images of other rendered pixels."""
        other = copy.copy(self)
        other.pixel_px = pixel_px
        return other

    def _numbers(self, values) -> Tensor:
        device = next((p.device for p in self.intensity.parameters()), None)
        return torch.tensor(list(values), dtype=torch.float64, device=device)

    def penalty(self, steps: Tensor) -> Tensor:
        """Squared distances (K,) from where the parameters most likely are, in standard deviations, weighted."""
        return self.weight * ((self.values(steps) - self.center) / self.width).square().sum(-1)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) within the bounds."""
        return torch.minimum(torch.maximum(steps, self.low), self.high)

    def at_bounds(self, share: float) -> list[str]:
        """Names of the parameters that are within a share of their range of a bound where they are not likely to be."""
        margin = share * (self.high - self.low)
        likely = (self.center - self.start) / self.scale
        near = ((self.low > -margin) & (likely > self.low)) | ((self.high < margin) & (likely < self.high))
        return [name for name, is_near in zip(self.names, near.tolist(), strict=True) if is_near]

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, D) of the parameters after steps."""
        return self.start + self.scale * steps

    def arguments(self, steps: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of the intensity model, each of shape (K,)."""
        values = {f.attribute: v for f, v in zip(self.free, self.values(steps).unbind(-1), strict=True)}
        own = self.intensity.arguments(self.pixel_px, **values)
        return {name: value.expand(len(steps)) for name, value in own.items()}

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Writes the stepped values into the model."""
        for free, value in zip(self.free, self.values(steps), strict=True):
            getattr(self.intensity, free.attribute).fill_(float(value))

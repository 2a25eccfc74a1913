"""Parameters of the intensity model that are estimated beside the motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .config import RegistrationConfig
from .scene import Scene

# Parameter: (name in the intensity model, change for a unit step, lower bound, upper bound). The unit steps change a
# radiograph about as much as a millimetre of motion, so that one step size suits all parameters.
_PARAMETERS = {
    "scatter": ("scatter", 0.05, 0.0, 0.9),
    "removed": ("scatter_removed", 0.05, 0.0, 0.9),
    "blur": ("blur_sigma_px", 0.5, 0.1, 5.0),
    "hardness": ("hardness", 2.0, -5.0, 20.0),
}
_LIKELY_SCATTER = 0.2  # about the start: scanners and limbs differ that much
_LIKELY_BLUR = 0.4  # of the start: focal spots and scintillators
_LIKELY_HARDNESS_MM = (3.0, 0.5)  # of aluminium: spectrum unknown, known


class Nuisance:
    """Steps of the intensity model's parameters, scaled like millimetres.

    Args:
        scene: With the intensity model; one without the named parameters (the identity) has nothing to estimate.
        config: Where the parameters start, which is also where they most likely are.
        names: Parameters to estimate.
        pixel_size: Of the images the model sees, in the detector's pixels; the model keeps its blur in the latter.
    """

    def __init__(self, scene: Scene, config: RegistrationConfig, names: Sequence[str], pixel_size: float) -> None:
        self.pixel_size = pixel_size
        self.own = dict(scene.intensity.named_parameters())
        self.names = [name for name in names if _PARAMETERS[name][0] in self.own]
        table = [_PARAMETERS[name] for name in self.names]
        self.attributes = [row[0] for row in table]
        self.scale = torch.tensor([row[1] for row in table], dtype=torch.float64)
        low, high = (torch.tensor([row[i] for row in table], dtype=torch.float64) for i in (2, 3))
        start = [float(self.own[a].detach()) for a in self.attributes]
        self.start = torch.tensor(start, dtype=torch.float64)
        self.low, self.high = (low - self.start) / self.scale, (high - self.start) / self.scale
        likely = {
            "scatter": (config.scatter, _LIKELY_SCATTER),
            "removed": (0.0, _LIKELY_SCATTER),
            "blur": (config.blur_px, _LIKELY_BLUR * config.blur_px),
            "hardness": (0.0, _LIKELY_HARDNESS_MM[scene.knows_spectrum]),
        }
        self.likely = torch.tensor([likely[name] for name in self.names], dtype=torch.float64).reshape(-1, 2)

    def penalty(self, steps: Tensor) -> Tensor:
        """Squared distances (K,) from where the parameters most likely are, in standard deviations, summed."""
        center, width = self.likely.unbind(-1)
        return ((self.values(steps) - center) / width).square().sum(-1)

    @property
    def num_parameters(self) -> int:
        """One each."""
        return len(self.names)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) within the bounds."""
        return torch.minimum(torch.maximum(steps, self.low), self.high)

    def at_bounds(self, share: float) -> list[str]:
        """Names of the parameters that are within a share of their range of a bound where they are not likely to be."""
        margin = share * (self.high - self.low)
        likely = (self.likely[:, 0] - self.start) / self.scale
        near = ((self.low > -margin) & (likely > self.low)) | ((self.high < margin) & (likely < self.high))
        return [name for name, is_near in zip(self.names, near.tolist(), strict=True) if is_near]

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, D) of the parameters after steps."""
        return self.start + self.scale * steps

    def __call__(self, steps: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of the intensity model, each of shape (K,); the blur in the images' own pixels."""
        values = dict(zip(self.attributes, self.values(steps).unbind(-1), strict=True))
        for name, own in self.own.items():
            values.setdefault(name, own.detach().expand(len(steps)))
        if "blur_sigma_px" in values:
            values["blur_sigma_px"] = values["blur_sigma_px"] / self.pixel_size
        return {name: value.float() for name, value in values.items()}

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Writes the stepped values into the model."""
        for attribute, value in zip(self.attributes, self.values(steps), strict=True):
            self.own[attribute].fill_(float(value))

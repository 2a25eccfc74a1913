"""Parameters of the intensity model that are estimated beside the motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

# Parameter: (name in the intensity model, change for a unit step, lower bound, upper bound). The unit steps change a
# radiograph about as much as a millimetre of motion, so that one step size suits all parameters.
_PARAMETERS = {
    "scatter": ("scatter", 0.05, 0.0, 0.6),
    "blur": ("blur_sigma_px", 0.5, 0.0, 5.0),
    "hardness": ("hardness", 2.0, -5.0, 20.0),
}


class Nuisance:
    """Steps of the intensity model's parameters, scaled like millimetres.

    Args:
        intensity: The model; one without the named parameters (the identity) has nothing to estimate.
        names: Parameters to estimate.
        pixel_size: Of the images the model sees, in the detector's pixels; the model keeps its blur in the latter.
    """

    def __init__(self, intensity: nn.Module, names: Sequence[str], pixel_size: float) -> None:
        self.pixel_size = pixel_size
        self.own = dict(intensity.named_parameters())
        self.names = [name for name in names if _PARAMETERS[name][0] in self.own]
        table = [_PARAMETERS[name] for name in self.names]
        self.attributes = [row[0] for row in table]
        self.scale = torch.tensor([row[1] for row in table], dtype=torch.float64)
        low, high = (torch.tensor([row[i] for row in table], dtype=torch.float64) for i in (2, 3))
        start = [float(self.own[a].detach()) for a in self.attributes]
        self.start = torch.tensor(start, dtype=torch.float64)
        self.low, self.high = (low - self.start) / self.scale, (high - self.start) / self.scale

    @property
    def num_parameters(self) -> int:
        """One each."""
        return len(self.names)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) within the bounds."""
        return torch.minimum(torch.maximum(steps, self.low), self.high)

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, D) of the parameters after steps."""
        return self.start + self.scale * steps

    def __call__(self, steps: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of the intensity model, each of shape (K,); the blur in the images' own pixels."""
        values = dict(zip(self.attributes, self.values(steps).unbind(-1), strict=True))
        if "blur_sigma_px" in self.own:
            blur = values.get("blur_sigma_px", self.own["blur_sigma_px"].detach().expand(len(steps)))
            values["blur_sigma_px"] = blur / self.pixel_size
        return {name: value.float() for name, value in values.items()}

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Writes the stepped values into the model."""
        for attribute, value in zip(self.attributes, self.values(steps), strict=True):
            self.own[attribute].fill_(float(value))

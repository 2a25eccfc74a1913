"""What the model does not know, as a smooth path length: bone, water, soft tissue."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur, scattered_signal

from .config import RegistrationConfig, Stage
from .data import RegistrationData, resized
from .following import PIXELS_OF_SIGMA
from .model import StageModel
from .scene import Scene

_ITERATIONS = 4
_PROBE_MM = 0.5


@torch.no_grad()
def with_background(
    scene: Scene, data: RegistrationData, config: RegistrationConfig, smoothness_mm: float | None = None
) -> RegistrationData:
    """The data with a path length B of ``config.background_material`` that stands for what is not known.

    The measured transmission is ``T(B) + s`` with T of the known components behind a background B, and the scatter s.
    Within a Gaussian window of ``smoothness_mm`` a factor of T is fitted by least squares,
    ``r = G (T (I - s)) / G (T T)``, and B moves by Newton's rule until it is one. Pixels behind thick metal hardly
    count, so that B goes on under the implant from its surroundings. It is too smooth to take over edges that the
    implant should explain, but behind bone or water it sets how hard the beam is and how much of the signal is
    scatter, which decides how an edge looks.

    Args:
        scene: Implant near its pose, with its intensity model.
        data: Projections.
        config: Background material, backend.
        smoothness_mm: Standard deviation of the window at the detector; None: ``config.background_mm``.
    """
    width = config.background_mm if smoothness_mm is None else smoothness_mm
    background = _BackgroundFit(scene, data, config, width)()
    return replace(data, background=resized(background, data.geometry.det_shape), background_mm=width)


class _BackgroundFit:
    """The background that goes with the parameters of the intensity model."""

    def __init__(self, scene: Scene, data: RegistrationData, config: RegistrationConfig, width_mm: float) -> None:
        bare = replace(data, background=None)
        coarse = int(PIXELS_OF_SIGMA * width_mm / data.geometry.pixel_spacing[1])
        self.stage = Stage(groups=scene.num_groups, bin=min(max(coarse, 1), 4), pitch_factor=2, margin_mm=None)
        self.model = StageModel(scene, bare, self.stage, config)
        self.intensity = scene.intensity
        self.physics = self.model.nuisance(self.model.split(self.model.at_rest).physics)
        self.paths = self.model.path_lengths(self.model.at_rest)[:, :-1]
        self.measured = torch.exp(-self.model.data.line_integrals)
        self.sigma = width_mm / self.model.data.geometry.pixel_spacing[1]

    def __call__(self) -> Tensor:
        """Path length B (V, rows, cols), mm."""
        levels = torch.stack([self.physics["scatter"], self.physics["scatter_removed"]], dim=-1)
        physics = {**self.physics, "scatter": torch.zeros(1), "scatter_removed": torch.zeros(1)}
        primary = self.measured - scattered_signal(levels, self.model.data.scatter_shapes)[0]
        background = torch.zeros_like(primary)
        for _ in range(_ITERATIONS):
            known = self._transmission(background, physics)
            squares = self._window(known.square())
            further = self._transmission(background + _PROBE_MM, physics)
            slope = (squares / self._window(known * further)).log() / _PROBE_MM
            ratio = self._window(known * primary) / squares
            background = background - ratio.clamp(0.02, 5.0).log() / slope.clamp_min(1e-3)
        return background

    def _transmission(self, background: Tensor, physics: dict[str, Tensor]) -> Tensor:
        unknown = resized(background, (self.paths.shape[-2], self.paths.shape[-1]))
        lengths = torch.cat([self.paths, unknown[None, None]], dim=1)
        return torch.exp(-self.intensity(lengths, pooling=self.stage.oversampling, **physics))[0]

    def _window(self, image: Tensor) -> Tensor:
        return gaussian_blur(image * self.model.data.mask, self.sigma).clamp_min(1e-6)

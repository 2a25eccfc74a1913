"""What the model does not know, as a smooth path length: bone, water, soft tissue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur

from .config import RegistrationConfig, Stage
from .data import RegistrationData, resized
from .model import StageModel
from .scene import Scene

_PIXELS_OF_SIGMA = 0.4  # a pixel is no larger than this share of the smoothness
_ITERATIONS = 4
_STEPS = {"scatter": 0.01, "hardness": 0.2}
_PROBE_MM = 0.5


@torch.no_grad()
def with_background(
    scene: Scene, data: RegistrationData, config: RegistrationConfig, *, follows: Sequence[str] = ()
) -> RegistrationData:
    """The data with a path length B of ``config.background_material`` that stands for what is not known.

    The measured transmission is ``T(B) + s`` with T of the known components behind a background B, and the scatter s.
    Within a Gaussian window of ``config.background_mm`` a factor of T is fitted by least squares,
    ``r = G (T (I - s)) / G (T T)``, and B moves by Newton's rule until it is one. Pixels behind thick metal hardly
    count, so that B goes on under the implant from its surroundings. It is too smooth to take over edges that the
    implant should explain, but behind bone or water it sets how hard the beam is and how much of the signal is
    scatter, which decides how an edge looks.

    Args:
        scene: Implant near its pose, with its intensity model.
        data: Projections.
        config: Smoothness, backend.
        follows: Parameters of the intensity model with which B changes: also how it does. A fit of them then takes B
            along (variable projection, Golub & Pereyra 1973): a level is explained by the background and by the scatter
            alike, and with one of them held the other would have to explain both.
    """
    fit = _BackgroundFit(scene, data, config)
    background, slopes = fit(), {}
    for name in follows:
        step = _STEPS[name]
        slopes[name] = resized((fit(background, **{name: step}) - background) / step, data.geometry.det_shape)
    return replace(data, background=resized(background, data.geometry.det_shape), background_slopes=slopes)


class _BackgroundFit:
    """The background that goes with the parameters of the intensity model."""

    def __init__(self, scene: Scene, data: RegistrationData, config: RegistrationConfig) -> None:
        bare = replace(data, background=None, background_slopes={})
        coarse = int(_PIXELS_OF_SIGMA * config.background_mm / data.geometry.pixel_spacing[1])
        self.stage = Stage(groups=scene.num_groups, bin=min(max(coarse, 1), 4), pitch_factor=2, margin_mm=None)
        self.model = StageModel(scene, bare, self.stage, config)
        self.intensity = scene.intensity
        self.physics = self.model.nuisance(self.model.split(self.model.at_rest).physics)
        self.paths = self.model.path_lengths(self.model.at_rest)[:, :-1]
        self.measured = torch.exp(-self.model.data.line_integrals)
        self.sigma = config.background_mm / self.model.data.geometry.pixel_spacing[1]

    def __call__(self, start: Tensor | None = None, *, scatter: float = 0.0, hardness: float = 0.0) -> Tensor:
        """Path length B (V, rows, cols), mm; for changed parameters from where it was without the change."""
        scatter = scatter + self._own("scatter")
        physics = {**self.physics, "scatter": torch.zeros(1), "hardness": torch.full((1,), self._own("hardness"))}
        physics["hardness"] += hardness
        shape = self.model.data.scatter_shape
        primary = self.measured - scatter * (1.0 if shape is None else shape)
        background = torch.zeros_like(primary) if start is None else start
        for _ in range(_ITERATIONS if start is None else _ITERATIONS // 2):
            known = self._transmission(background, physics)
            squares = self._window(known.square())
            further = self._transmission(background + _PROBE_MM, physics)
            slope = (squares / self._window(known * further)).log() / _PROBE_MM
            ratio = self._window(known * primary) / squares
            background = background - ratio.clamp(0.02, 5.0).log() / slope.clamp_min(1e-3)
        return background

    def _own(self, name: str) -> float:
        return float(self.intensity.get_parameter(name).detach())

    def _transmission(self, background: Tensor, physics: dict[str, Tensor]) -> Tensor:
        unknown = resized(background, (self.paths.shape[-2], self.paths.shape[-1]))
        lengths = torch.cat([self.paths, unknown[None, None]], dim=1)
        return torch.exp(-self.intensity(lengths, pooling=self.stage.oversampling, **physics))[0]

    def _window(self, image: Tensor) -> Tensor:
        return gaussian_blur(image * self.model.data.mask, self.sigma).clamp_min(1e-6)

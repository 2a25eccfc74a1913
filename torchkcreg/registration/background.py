"""What the model does not know, as a smooth path length: bone, water, soft tissue."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur

from .config import RegistrationConfig, Stage
from .data import RegistrationData, resized
from .model import StageModel
from .scene import Scene

_ITERATIONS = 4
_PROBE_MM = 0.5


@torch.no_grad()
def estimate_background(scene: Scene, data: RegistrationData, config: RegistrationConfig) -> Tensor:
    """Path length B of ``config.background_material`` that stands for what is not known, shape (V, rows, cols), mm.

    The measured transmission is ``T(B) + s`` with T of the known components behind a background B, and the scatter s.
    Within a Gaussian window of ``config.background_mm`` a factor of T is fitted by least squares,
    ``r = G (T (I - s)) / G (T T)``, and B moves by Newton's rule until it is one. Pixels behind thick metal hardly
    count, so that B goes on under the implant from its surroundings. It is too smooth to take over edges that the
    implant should explain, but behind bone or water it sets how hard the beam is and how much of the signal is
    scatter, which decides how an edge looks.
    """
    stage = Stage(groups=scene.num_groups, bin=2, pitch_factor=2, margin_mm=None)
    model = StageModel(scene, replace(data, background=None), stage, config)
    physics = {**model.nuisance(model.split(model.at_rest)[1]), "scatter": torch.zeros(1)}
    paths = model.path_lengths(model.at_rest)[:, :-1]
    scatter = float(scene.intensity.get_parameter("scatter").detach())
    shape = 1.0 if model.data.scatter_shape is None else model.data.scatter_shape
    primary = torch.exp(-model.data.line_integrals) - scatter * shape
    sigma = config.background_mm / model.data.geometry.pixel_spacing[1]

    def transmission(background: Tensor) -> Tensor:
        unknown = resized(background, (paths.shape[-2], paths.shape[-1]))
        lengths = torch.cat([paths, unknown[None, None]], dim=1)
        return torch.exp(-scene.intensity(lengths, pooling=stage.oversampling, **physics))[0]

    def window(image: Tensor) -> Tensor:
        return gaussian_blur(image * model.data.mask, sigma).clamp_min(1e-6)

    background = torch.zeros_like(primary)
    for _ in range(_ITERATIONS):
        known = transmission(background)
        squares = window(known.square())
        slope = (squares / window(known * transmission(background + _PROBE_MM))).log() / _PROBE_MM
        ratio = window(known * primary) / squares
        background = background - ratio.clamp(0.02, 5.0).log() / slope.clamp_min(1e-3)
    return resized(background, data.geometry.det_shape)

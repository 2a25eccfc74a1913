"""What the model does not know, as a smooth attenuation: bone, water, soft tissue."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchkcreg.physics import gaussian_blur

from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .model import StageModel
from .scene import Scene


@torch.no_grad()
def estimate_background(scene: Scene, data: RegistrationData, config: RegistrationConfig) -> Tensor:
    """Share b of the beam that everything but the known components lets through, shape (V, rows, cols).

    The measured transmission is ``b T + s`` with T of the known components and the scatter floor s. Within a Gaussian
    window of ``config.background_mm`` b is taken as constant and fitted by least squares:
    ``b = G (T (I - s)) / G (T T)``. Pixels behind thick metal hardly count, so that b goes on under the implant from
    its surroundings. It is too smooth to take over edges that the implant should explain, but behind bone or water it
    sets how much of the signal is scatter, which decides how saturated an edge looks.
    """
    stage = Stage(groups=scene.num_groups, bin=2, pitch_factor=2, margin_mm=None)
    model = StageModel(scene, replace(data, background=None), stage, config)
    physics = {**model.nuisance(model.split(model.at_rest)[1]), "scatter": torch.zeros(1)}
    paths = model.path_lengths(model.at_rest)
    scatter = float(scene.intensity.get_parameter("scatter").detach())
    known = torch.exp(-scene.intensity(paths, pooling=stage.oversampling, **physics))[0]
    excess = torch.exp(-model.data.line_integrals) - scatter
    weights = known * model.data.mask
    sigma = config.background_mm / model.data.geometry.pixel_spacing[1]
    smooth = gaussian_blur(weights * excess, sigma) / gaussian_blur(weights * known, sigma).clamp_min(1e-6)
    share = smooth.clamp(0.01, 2.0)
    size = data.geometry.det_shape
    return interpolate(share[None], size=tuple(size), mode="bilinear", align_corners=False)[0]

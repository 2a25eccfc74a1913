"""Estimated background (bone, water, soft tissue) as a smooth path length."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur, scattered_signal

from .data import RegistrationData
from .following import PIXELS_OF_SIGMA, resized
from .scene import Scene

_ITERATIONS = 4
_PROBE_MM = 0.5
_COARSEST_BIN = 4
_LEAST_MEASURED = 0.01  # of a window: with fewer valid pixels the background is not estimated
_LEAST_SLOPE = 1e-3  # 1/mm, of the logarithm of the signal
_RANGE_MM = (-100.0, 2000.0)  # a limb's thickness in any view, and errors of the model on the other side


@torch.no_grad()
def with_background(scene: Scene, data: RegistrationData, smoothness_mm: float) -> RegistrationData:
    """The data with an estimated path length B of background material.

    The measured transmission is `T(B) + s` with T of the known components behind a background B, and the scatter s.
    Within a Gaussian window of `smoothness_mm` a factor of T is fitted by least squares,
    `r = G (T (I - s)) / G (T T)`, and B is changed by Newton steps until that factor is one. Pixels behind thick metal
    hardly count, so B under the implant continues its surroundings. B is too smooth to explain edges of the implant.
    But it determines beam hardness and scatter fraction behind bone or water, and thus the contrast of an edge.

    Args:
        scene: Implants near their poses, with an intensity model that has a background.
        data: Projections.
        smoothness_mm: Standard deviation of the window at the detector.

    Raises:
        ValueError: If the intensity model has no background.
    """
    if not scene.intensity.has_background:
        raise ValueError(f"{type(scene.intensity).__name__} knows no background that could be estimated")
    background = _BackgroundFit(scene, data, smoothness_mm)()
    return replace(data, background=resized(background, data.geometry.det_shape), background_mm=smoothness_mm)


class _BackgroundFit:
    """Least-squares fit of the background for the present intensity model."""

    def __init__(self, scene: Scene, data: RegistrationData, width_mm: float) -> None:
        coarse = int(PIXELS_OF_SIGMA * width_mm / data.geometry.pixel_spacing[1])
        bare = replace(data, background=None)
        self.view = scene.view(bare, bin=min(max(coarse, 1), _COARSEST_BIN), pitch_factor=2)
        self.intensity = scene.intensity
        state = scene.state(self.view)
        self.physics = dict(state.physics)
        self.paths = scene.path_lengths(self.view, state)[:, :-1]
        self.images = self.view.images
        self.measured = torch.exp(-self.images.line_integrals)
        self.sigma = width_mm / self.view.geometry.pixel_spacing[1]

    def __call__(self) -> Tensor:
        """Path length B (V, rows, cols), mm."""
        levels = torch.stack([self.physics["scatter"], self.physics["scatter_removed"]], dim=-1).to(self.measured)
        none = torch.zeros_like(self.physics["scatter"])
        physics = {**self.physics, "scatter": none, "scatter_removed": none}
        primary = self.measured - scattered_signal(levels, self.images.scatter_shapes)[0]
        background = torch.zeros_like(primary)
        measured = gaussian_blur(self.images.mask.to(primary), self.sigma) > _LEAST_MEASURED
        for _ in range(_ITERATIONS):
            known = self._transmission(background, physics)
            squares = self._window(known.square())
            further = self._transmission(background + _PROBE_MM, physics)
            slope = (squares / self._window(known * further)).log() / _PROBE_MM
            ratio = self._window(known * primary) / squares
            step = ratio.clamp(0.02, 5.0).log() / slope.clamp_min(_LEAST_SLOPE)
            background = torch.where(measured, background - step, background).clamp(*_RANGE_MM)
        return background

    def _transmission(self, background: Tensor, physics: dict[str, Tensor]) -> Tensor:
        unknown = resized(background, (self.paths.shape[-2], self.paths.shape[-1]))
        lengths = torch.cat([self.paths, unknown[None, None]], dim=1)
        return torch.exp(-self.intensity(lengths, pooling=self.view.oversampling, **physics))[0]

    def _window(self, image: Tensor) -> Tensor:
        return gaussian_blur(image * self.images.mask, self.sigma).clamp_min(1e-6)

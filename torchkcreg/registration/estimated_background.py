"""Estimated background and scatter of the images."""

from __future__ import annotations

from torchkcreg.scene import RegistrationData, Scene, with_background

from .config import RegistrationConfig

_BACKGROUND_PIXELS = 4.0  # a finer background takes over the edges that a stage sees


def data_with_background(
    scene: Scene, data: RegistrationData, config: RegistrationConfig, bin: int
) -> RegistrationData:
    """The data with the background estimated for the scene, no finer than the binned pixels allow."""
    pixel = data.geometry.pixel_spacing[1]
    return with_background(scene, data, max(config.background_mm, _BACKGROUND_PIXELS * bin * pixel))


def facing_data(scene: Scene, data: RegistrationData, config: RegistrationConfig) -> RegistrationData:
    """The data with the implants in front of every source, and scatter shapes if the intensity model has scatter."""
    for assembly in scene:
        data = data.facing(assembly.nodes())
    if not scene.intensity.has_background or data.scatter_shapes is not None:
        return data
    return data.with_scatter_shapes(config.scatter_mm)

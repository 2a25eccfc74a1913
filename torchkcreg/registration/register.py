"""Registration in one call: from implant, projections and options to a measured deformation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchkcreg.deformation import FreeFormDeformation, default_grid
from torchkcreg.implant import Component, Hole, ImplantPointCloud
from torchkcreg.physics import IdentityIntensity, PolyenergeticTransmission, Spectrum, material, tungsten_spectrum

from .callbacks import Callback
from .config import RegistrationConfig
from .data import RegistrationData
from .result import RegistrationResult
from .scene import Scene
from .trainer import Trainer


def build_scene(
    implant: ImplantPointCloud,
    config: RegistrationConfig,
    *,
    spectrum: Spectrum | None = None,
    components: Sequence[Component] = (),
    implant_to_world: Tensor | None = None,
    holes: Sequence[Hole] = (),
) -> Scene:
    """The scene of a registration at its start pose.

    Args:
        implant: Undeformed implant in its own frame.
        config: Options; with ``material`` the DRR is polyenergetic, without it a plain path length.
        spectrum: Detected spectrum; a 90 kV tungsten spectrum when None.
        components: Screws and the like in the implant's frame.
        implant_to_world: Approximate pose (4, 4); the identity when None.
        holes: The implant's holes, where screws are looked for if no components are given.
    """
    grid = default_grid(implant.points, shape=config.grid_shape, spacing=config.grid_spacing_mm)
    pose = torch.eye(4, dtype=torch.float64) if implant_to_world is None else implant_to_world
    name = config.material or "implant"
    holes = holes if config.find_screws and not components else ()
    metals = config.screw_materials if holes and config.material is not None else ()
    names = list(dict.fromkeys([name, *metals, *(c.material for c in components)]))
    intensity: nn.Module = IdentityIntensity()
    if config.material is not None:
        intensity = PolyenergeticTransmission(
            [material(n) for n in [*names, config.background_material]],
            spectrum or tungsten_spectrum(),
            scatter=config.scatter,
            blur_sigma_px=config.blur_px,
        )
    return Scene(
        implant,
        FreeFormDeformation(grid),
        intensity,
        pose,
        components=components,
        material=name,
        follow_radius_mm=config.follow_radius_mm,
        holes=holes,
        metals=metals,
        knows_spectrum=spectrum is not None,
    )


def register(
    implant: ImplantPointCloud,
    data: RegistrationData,
    config: RegistrationConfig | None = None,
    *,
    spectrum: Spectrum | None = None,
    components: Sequence[Component] = (),
    implant_to_world: Tensor | None = None,
    holes: Sequence[Hole] = (),
    callbacks: Sequence[Callback] = (),
) -> RegistrationResult:
    """The deformation of an implant, measured in a few projections (FFD-KC-Reg, Cao et al. 2020).

    Args:
        implant: Undeformed implant in its own frame.
        data: Projections, masks and geometry.
        config: Options; the defaults when None.
        spectrum: Detected spectrum; a 90 kV tungsten spectrum when None.
        components: Screws and the like, in the implant's frame; each follows the implant near its head.
        implant_to_world: Approximate pose (4, 4); the identity when None.
        holes: The implant's holes, see :func:`torchkcreg.implant.find_holes`: where no components are given, screws are
            looked for in them.
        callbacks: See :class:`torchkcreg.registration.Callback`.
    """
    config = config or RegistrationConfig()
    scene = build_scene(
        implant,
        config,
        spectrum=spectrum,
        components=components,
        implant_to_world=implant_to_world,
        holes=holes,
    )
    return Trainer(scene, data, config, callbacks=callbacks).fit()

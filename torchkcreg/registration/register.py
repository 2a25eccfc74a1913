"""Registration in one call: from implant, projections and options to a measured deformation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchkcreg.callbacks import Callback
from torchkcreg.implant import Component, Hole, ImplantPointCloud, Screw
from torchkcreg.optimization import OptimizerFactory
from torchkcreg.physics import (
    IdentityIntensity,
    IntensityModel,
    PolyenergeticTransmission,
    Spectrum,
    material,
    tungsten_spectrum,
)
from torchkcreg.scene import Assembly, RegistrationData, Scene

from .config import RegistrationConfig
from .implant import DeformationFactory, Implant, deformation_of
from .objective import Penalty, SimilarityFactory
from .result import RegistrationResult
from .stage import Step, Terms
from .trainer import Trainer


def build_scene(
    implants: ImplantPointCloud | Implant | Sequence[Implant],
    config: RegistrationConfig,
    *,
    spectrum: Spectrum | None = None,
    components: Sequence[Component | Screw] = (),
    implant_to_world: Tensor | None = None,
    holes: Sequence[Hole] = (),
    deformation: DeformationFactory = deformation_of,
    intensity: IntensityModel | None = None,
) -> Scene:
    """The scene of a registration at its start.

    Args:
        implants: Undeformed implant in its own frame; or several, each an `Implant` with its components.
        config: Options; with `material` the DRR is polyenergetic, without it a plain path length.
        spectrum: Detected spectrum; a 90 kV tungsten spectrum when None.
        components: Components of a single implant, see `Implant`.
        implant_to_world: Pose (4, 4) of a single implant.
        holes: Holes of a single implant.
        deformation: Makes the deformation of `(implant, config)`.
        intensity: Model in place of the options' model; its path lengths are those of the implants'
            materials, in their order, then of screws' materials, then of components' materials.

    Raises:
        ValueError: If several implants are given together with components, a pose or holes.
    """
    if isinstance(implants, ImplantPointCloud):
        implants = Implant(implants, components, holes, implant_to_world)
    elif components or holes or implant_to_world is not None:
        raise ValueError("components, holes and implant_to_world belong into each Implant where those are given")
    several = [implants] if isinstance(implants, Implant) else list(implants)
    default = config.material or "implant"
    assemblies = [
        Assembly(
            implant.cloud,
            deformation(implant, config),
            implant_to_world=implant.implant_to_world,
            material=implant.material or default,
            components=implant.components,
            holes=implant.holes if config.find_screws and not implant.components else (),
            follow_radius_mm=config.follow_radius_mm,
            name=implant.name,
        )
        for implant in several
    ]
    looks = any(assembly.holes for assembly in assemblies) and config.material is not None
    scene = Scene(assemblies, metals=config.screw_materials if looks else (), backend=config.backend)
    scene.intensity = intensity or _intensity(scene.materials, config, spectrum)
    return scene.to(several[0].cloud.points.device)


def _intensity(names: Sequence[str], config: RegistrationConfig, spectrum: Spectrum | None) -> IntensityModel:
    if config.material is None:
        return IdentityIntensity()
    return PolyenergeticTransmission(
        [material(name) for name in names],
        spectrum or tungsten_spectrum(),
        scatter=config.scatter,
        blur_sigma_px=config.blur_px,
        background=material(config.background_material),
        spectrum_is_known=spectrum is not None,
    )


def register(
    implants: ImplantPointCloud | Implant | Sequence[Implant],
    data: RegistrationData,
    config: RegistrationConfig | None = None,
    *,
    spectrum: Spectrum | None = None,
    components: Sequence[Component | Screw] = (),
    implant_to_world: Tensor | None = None,
    holes: Sequence[Hole] = (),
    deformation: DeformationFactory = deformation_of,
    intensity: IntensityModel | None = None,
    similarity: SimilarityFactory | None = None,
    penalties: Sequence[Penalty] = (),
    optimizer: OptimizerFactory | None = None,
    steps: Mapping[str, Step] | None = None,
    start: RegistrationResult | None = None,
    callbacks: Sequence[Callback] = (),
    seconds: float | None = None,
) -> RegistrationResult:
    """The deformation of an implant, measured in a few projections (FFD-KC-Reg, Cao et al. 2020).

    Args:
        implants: Undeformed implant in its own frame; or several, each an `Implant` with its components.
        data: Measured line integrals with their masks and geometry.
        config: Options; the defaults when None.
        spectrum: Detected spectrum; a 90 kV tungsten spectrum when None.
        components: Components of a single implant, see `Implant`.
        implant_to_world: Approximate pose (4, 4) of a single implant; the identity when None.
        holes: Holes of a single implant.
        deformation: Makes the deformation of `(implant, config)`: by default as the options say.
        intensity: Model in place of the options' model, see `build_scene`.
        similarity: Makes the similarity of `(fixed, mask, weights)`, in place of those that the stages name.
        penalties: Each takes a `torchkcreg.scene.State` of K candidates and returns K penalties (K,), added to the
            priors.
        optimizer: Makes the optimiser of `(problem, stage, seed)`, in place of the stages'.
        steps: Additional steps, by the names used in stages.
        start: Earlier registration of the same implants. Its poses and intensity parameters are the start; its
            deformations are not taken over.
        callbacks: See `torchkcreg.registration.Callback`.
        seconds: Time limit; after it the registration ends with the current iteration and the result says so.

    Raises:
        ValueError: If the pieces do not fit together.
    """
    config = config or RegistrationConfig()
    scene = build_scene(
        implants,
        config,
        spectrum=spectrum,
        components=components,
        implant_to_world=implant_to_world,
        holes=holes,
        deformation=deformation,
        intensity=intensity,
    )
    if start is not None:
        _start_from(scene, start)
    terms = Terms(similarity, tuple(penalties), optimizer)
    return Trainer(scene, data, config, callbacks=callbacks, terms=terms, steps=steps, seconds=seconds).fit()


@torch.no_grad()
def _start_from(scene: Scene, start: RegistrationResult) -> None:
    """Set poses and intensity parameters from an earlier result; the implants start undeformed."""
    for assembly in scene:
        assembly.implant_to_world = start.implant(assembly.name).implant_to_world
    for name, value in scene.intensity.named_parameters():
        if name in start.intensity:
            value.fill_(start.intensity[name])

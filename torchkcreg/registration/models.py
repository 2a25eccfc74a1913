"""The deformation of an implant that a registration's options ask for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from torchkcreg.deformation import Deformation, FiniteElementDeformation, FreeFormDeformation
from torchkcreg.implant import Component, Hole, ImplantPointCloud
from torchkcreg.mechanics import Hold, LoadPrior, Superelement, holds_of
from torchkcreg.physics import elastic_constants, is_elastic
from torchkcreg.splines import default_grid

from .config import RegistrationConfig


@dataclass(frozen=True)
class Implant:
    """An implant as a registration is told of it.

    Attributes:
        cloud: Undeformed implant in its own frame.
        components: Screws and the like, in the implant's frame; each follows the implant near its head.
        holes: Its holes, see :func:`torchkcreg.implant.find_holes`: where no components are given, screws are looked
            for in them; finite elements are loaded there.
        implant_to_world: Approximate pose (4, 4); the identity when None.
        material: Name of its material; that of the options when None.
        name: How results refer to it.
        holds: Where finite elements are loaded, in place of the holes, with screws or without.
    """

    cloud: ImplantPointCloud
    components: Sequence[Component] = ()
    holes: Sequence[Hole] = ()
    implant_to_world: Tensor | None = None
    material: str | None = None
    name: str = "implant"
    holds: Sequence[Hold] = ()


DeformationFactory = Callable[[Implant, RegistrationConfig], Deformation]


def deformation_of(implant: Implant, config: RegistrationConfig) -> Deformation:
    """The deformation that a configuration describes; "auto": finite elements where the stiffness is known.

    Raises:
        ValueError: If finite elements are asked for an implant whose material is not said, or has no known stiffness.
    """
    material = implant.material or config.material
    known = material is not None and is_elastic(material)
    if config.deformation == "fe" or (config.deformation == "auto" and known):
        return finite_elements(implant, config)
    grid = default_grid(implant.cloud.points, shape=config.grid_shape, spacing=config.grid_spacing_mm)
    return FreeFormDeformation(grid, prior=config.bending_prior)


def finite_elements(implant: Implant, config: RegistrationConfig) -> FiniteElementDeformation:
    """An elastic body of the implant's material, loaded at its holds."""
    material = implant.material or config.material
    if material is None:
        raise ValueError("finite elements need the implant's material: give --material, or Implant.material")
    cloud = implant.cloud.to("cpu")
    superelement = Superelement.of(
        cloud,
        elastic_constants(material),
        implant.holds or holds_of(cloud, implant.holes),
        prior=LoadPrior(config.hold_force_n, config.hold_moment_nmm),
    )
    unused = 1.0 if implant.holds else config.hold_unused
    if config.hold_weight is None:
        return FiniteElementDeformation(superelement, weighed=True, unused=unused)
    return FiniteElementDeformation(superelement, load_weight=config.hold_weight, unused=unused)

"""An implant as input of a registration, and its deformation model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchkcreg.deformation import (
    Deformation,
    FiniteElementDeformation,
    FreeFormDeformation,
    RigidDeformation,
    bent_cloud,
    bent_hold,
    spread_of_rest,
)
from torchkcreg.implant import Component, Hole, ImplantPointCloud, Screw
from torchkcreg.mechanics import Hold, LoadPrior, Superelement, holds_of
from torchkcreg.physics import elastic_constants, is_elastic
from torchkcreg.splines import default_grid

from .config import RegistrationConfig
from .registered_implant import RegisteredImplant


@dataclass(frozen=True)
class Implant:
    """An implant to register.

    Attributes:
        cloud: Undeformed implant in its own frame.
        components: Screws and the like, in the implant's frame; each follows the implant near its head.
        holes: Its holes, see `torchkcreg.implant.find_holes`: if no components are given, screws are searched
            for in them; finite elements are loaded there.
        implant_to_world: Approximate pose (4, 4); the identity when None.
        material: Name of its material; that of the options when None.
        name: How results refer to it.
        holds: Where finite elements are loaded, instead of at the holes of the undeformed implant.
        rest: The implant as it was registered without load: finite elements bend it from that shape.
    """

    cloud: ImplantPointCloud
    components: Sequence[Component | Screw] = ()
    holes: Sequence[Hole] = ()
    implant_to_world: Tensor | None = None
    material: str | None = None
    name: str = "implant"
    holds: Sequence[Hold] = ()
    rest: RegisteredImplant | None = None


DeformationFactory = Callable[[Implant, RegistrationConfig], Deformation]


def deformation_of(implant: Implant, config: RegistrationConfig) -> Deformation:
    """The deformation that a configuration describes; "auto": finite elements where the stiffness is known.

    Raises:
        ValueError: If finite elements are asked for an implant whose material is not given, or has no known stiffness;
            if another model is asked for one whose shape without load is given.
    """
    if bends_elastically(config, implant.material):
        return finite_elements(implant, config)
    if implant.rest is not None:
        raise ValueError("a shape without load is what finite elements bend: ask for them with --deformation fe")
    if config.deformation == "rigid":
        return RigidDeformation()
    grid = default_grid(
        implant.cloud.points, shape=config.grid_shape, spacing=config.grid_spacing_mm, grows=config.grid_grows
    )
    return FreeFormDeformation(grid, prior=config.bending_prior)


def bends_elastically(config: RegistrationConfig, material: str | None = None) -> bool:
    """True if an implant of a material (default: that of the options) is bent by finite elements."""
    named = material or config.material
    return config.deformation == "fe" or (config.deformation == "auto" and named is not None and is_elastic(named))


def finite_elements(implant: Implant, config: RegistrationConfig) -> FiniteElementDeformation:
    """An elastic body of the implant's material, loaded at its holds."""
    material = implant.material or config.material
    if material is None:
        raise ValueError("finite elements need the implant's material: give --material, or Implant.material")
    cloud = implant.cloud.to("cpu")
    holds = implant.holds or holds_of(cloud, implant.holes)
    if implant.rest is not None:
        shape = implant.rest.deformation
        cloud, holds = bent_cloud(cloud, shape), [bent_hold(hold, shape) for hold in holds]
    prior = LoadPrior(config.hold_force_n, config.hold_moment_nmm)
    superelement = Superelement.of(cloud, elastic_constants(material), holds, prior=prior)
    unused = 1.0 if implant.holds else config.hold_unused
    known = {"weighed": True} if config.hold_weight is None else {"load_weight": config.hold_weight}
    return FiniteElementDeformation(superelement, unused=unused, **known, **_rest(implant.rest, superelement))


def _rest(rest: RegisteredImplant | None, element: Superelement) -> dict[str, Any]:
    if rest is None:
        return {}
    doubt = rest.deviations
    spread = None if doubt is None else spread_of_rest(element, rest.deformation, doubt, rest.implant_to_world)
    return {"rest": rest.deformation, "rest_spread": spread}

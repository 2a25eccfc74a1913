"""The outcome of a registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import Deformation
from torchkcreg.geometry import ConeBeamGeometry, transform_points
from torchkcreg.implant import Screw
from torchkcreg.scene import Assembly, Scene

from .config import RegistrationConfig
from .verdict import Status


@dataclass
class RegisteredImplant:
    """One implant of a registration: ``T(x) = implant_to_world (x + u(x))`` (eq. 1 of Cao et al. 2020).

    Attributes:
        name: Its name in the scene.
        implant_to_world: Global rigid transform, shape (4, 4), float64.
        deformation: Displacements u in the implant's frame.
        material: Name of its material.
        components: Rigid motion (4, 4) of each component in the implant's frame.
        screws: Those of the components that are screws, in the implant's frame before the motion.
        found: Names of the screws that were found, not given.
    """

    name: str
    implant_to_world: Tensor
    deformation: Deformation
    material: str = "implant"
    components: Mapping[str, Tensor] = field(default_factory=dict)
    screws: list[Screw] = field(default_factory=list)
    found: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, assembly: Assembly) -> RegisteredImplant:
        """An assembly as it is now."""
        return cls(
            name=assembly.name,
            implant_to_world=assembly.implant_to_world.clone(),
            deformation=assembly.deformation,
            material=assembly.material,
            components=assembly.component_motions(),
            screws=[c.as_screw for c in assembly.components if c.as_screw is not None],
            found=[screw.name for screw in assembly.found],
        )

    @torch.no_grad()
    def displacement(self, points: Tensor) -> Tensor:
        """u (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64 and that frame."""
        flat = points.detach().to(self.implant_to_world).reshape(-1, 3)
        return self.deformation.displacement(flat).reshape(points.shape)

    @torch.no_grad()
    def warp(self, points: Tensor) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64."""
        flat = points.detach().to(self.implant_to_world).reshape(-1, 3)
        return transform_points(self.implant_to_world, flat + self.displacement(flat)).reshape(points.shape)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) where the deformation only goes on from elsewhere."""
        return self.deformation.outside(points.to(self.implant_to_world))

    def deformed(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """A mesh of the undeformed implant's frame, in its place in the world; its faces are not divided."""
        vertices = self.warp(torch.from_numpy(mesh.vertices.copy()))
        return trimesh.Trimesh(vertices.cpu().numpy(), mesh.faces, process=False)


@dataclass
class RegistrationResult:
    """What a registration found.

    Attributes:
        implants: Each of the registered implants; the first one is what `warp` and its like mean without a name.
        gc: Gradient correlation of each view at the end, shape (V,).
        history: One record an iteration: stage, iteration, loss, step_mm, seconds.
        stages: One record a stage: iterations, converged, loss, undone.
        config: Options that made the result.
        seed: Seed of the random numbers.
        status: "ok", "doubtful" or "failed": whether the result can be trusted, for the reasons in ``warnings``.
        warnings: What a user should know before trusting the numbers.
        diagnostics: What the verdict rests on, see ``Diagnostics``; ``node_std_mm`` is the expected root mean square
            error of the implant's nodes.
        intensity: Estimated parameters of the intensity model.
        scene: The scene as it was registered; None for one that was read from a run folder.
    """

    implants: list[RegisteredImplant]
    gc: Tensor
    history: list[dict[str, Any]]
    config: RegistrationConfig
    seed: int = 0
    status: Status = "ok"
    warnings: list[str] = field(default_factory=list)
    diagnostics: dict[str, Any] = field(default_factory=dict)
    stages: list[dict[str, Any]] = field(default_factory=list)
    intensity: dict[str, float] = field(default_factory=dict)
    scene: Scene | None = field(default=None, repr=False)

    def implant(self, name: str | None = None) -> RegisteredImplant:
        """The implant of a name; the first one without.

        Raises:
            KeyError: If there is none of that name.
        """
        found = [i for i in self.implants if name in (None, i.name)]
        if not found:
            raise KeyError(f"no implant {name!r}: there are {', '.join(i.name for i in self.implants)}")
        return found[0]

    @property
    def implant_to_world(self) -> Tensor:
        """Of the first implant."""
        return self.implants[0].implant_to_world

    @property
    def deformation(self) -> Deformation:
        """Of the first implant."""
        return self.implants[0].deformation

    @property
    def components(self) -> Mapping[str, Tensor]:
        """Of the first implant."""
        return self.implants[0].components

    @property
    def screws_found(self) -> list[Screw]:
        """Screws that were found in the first implant, not given, in its frame before the motion."""
        first = self.implants[0]
        return [screw for screw in first.screws if screw.name in first.found]

    def warp(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64.

        Points beyond the control-point grid move rigidly with the nearest group; :meth:`outside` flags them.
        """
        return self.implant(implant).warp(points)

    def displacement(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """Bending u (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in that frame."""
        return self.implant(implant).displacement(points)

    def outside(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """True for points (..., 3) beyond the valid domain of the control-point grid."""
        return self.implant(implant).outside(points)

    def deformed(self, mesh: trimesh.Trimesh, *, implant: str | None = None) -> trimesh.Trimesh:
        """A mesh of the undeformed implant's frame, in its place in the world."""
        return self.implant(implant).deformed(mesh)

    @torch.no_grad()
    def project(self, geometry: ConeBeamGeometry) -> Tensor:
        """Line integrals (V, rows, cols) of the registered implants and their components in any views.

        Raises:
            ValueError: If the result was read from files, which do not keep the implants' nodes.
        """
        if self.scene is None:
            raise ValueError("the result has no scene to project: it was read from files")
        return self.scene(geometry)

    def __repr__(self) -> str:
        gc = " ".join(f"{value:.3f}" for value in self.gc.tolist())
        names = ", ".join(implant.name for implant in self.implants)
        deviation = self.diagnostics.get("node_std_mm")
        expected = "" if deviation is None else f", expected error {deviation:.3f} mm"
        text = f"RegistrationResult({self.status}: {names}, gc {gc}{expected})"
        return "\n".join([text, *(f"  {warning}" for warning in self.warnings)])

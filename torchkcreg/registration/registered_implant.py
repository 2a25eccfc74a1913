"""One registered implant: pose, bending, screws and expected errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import Deformation, Deviations, deformation_from_dict
from torchkcreg.geometry import transform_points
from torchkcreg.implant import ImplantPointCloud, KnownComponent, Screw, deformed_surface
from torchkcreg.plain import finite_array, require_keys
from torchkcreg.scene import Assembly, followed_motion

_BENT_EDGE_MM = 2.0
_NODES_PITCH_MM = 1.0


@dataclass
class RegisteredImplant:
    """One implant of a registration: `T(x) = implant_to_world (x + u(x))` (eq. 1 of Cao et al. 2020).

    Attributes:
        name: Its name in the scene.
        implant_to_world: Global rigid transform, shape (4, 4), float64.
        deformation: Displacements u in the implant's frame.
        material: Name of its material; None if the registration had none.
        components: Rigid motion (4, 4) of each component in the implant's frame.
        screws: The components that are screws, in the implant's frame before the motion.
        found: Names of the screws that were found, not given.
        follow_radius_mm: A component follows the implant's nodes within this distance of its head, mm.
        cloud: The undeformed implant's nodes; None if the result was read from a run folder.
        deviations: Expected deviations; None if unknown.
    """

    name: str
    implant_to_world: Tensor
    deformation: Deformation
    material: str | None = None
    components: Mapping[str, Tensor] = field(default_factory=dict)
    screws: list[Screw] = field(default_factory=list)
    found: list[str] = field(default_factory=list)
    follow_radius_mm: float = 8.0
    cloud: ImplantPointCloud | None = field(default=None, repr=False)
    deviations: Deviations | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls, assembly: Assembly, *, has_material: bool = True, deviations: Deviations | None = None
    ) -> RegisteredImplant:
        """The registered implant of an assembly's present state."""
        return cls(
            name=assembly.name,
            implant_to_world=assembly.implant_to_world.detach(),
            deformation=assembly.deformation,
            material=assembly.material if has_material else None,
            components=assembly.component_motions(),
            screws=[c.as_screw for c in assembly.components if c.as_screw is not None],
            found=[screw.name for screw in assembly.found],
            follow_radius_mm=assembly.follow_radius_mm,
            cloud=assembly.implant,
            deviations=deviations,
        )

    def to(self, device: torch.device | str) -> RegisteredImplant:
        """The implant on a device; its modules are moved, not copied."""
        return replace(
            self,
            implant_to_world=self.implant_to_world.to(device),
            deformation=self.deformation.to(device),
            components={name: motion.to(device) for name, motion in self.components.items()},
            cloud=None if self.cloud is None else self.cloud.to(device),
            deviations=None if self.deviations is None else self.deviations.to(device),
        )

    @torch.no_grad()
    def displacement(self, points: Tensor) -> Tensor:
        """U (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64 and that frame."""
        flat = points.detach().to(self.implant_to_world).reshape(-1, 3)
        return self.deformation.displacement(flat).reshape(points.shape)

    @torch.no_grad()
    def warp(self, points: Tensor) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64."""
        flat = points.detach().to(self.implant_to_world).reshape(-1, 3)
        return transform_points(self.implant_to_world, flat + self.displacement(flat)).reshape(points.shape)

    def outside(self, points: Tensor) -> Tensor:
        """True for points (..., 3) outside the deformation's valid domain, where it is extrapolated."""
        return self.deformation.outside(points.to(self.implant_to_world))

    def deformed(self, mesh: trimesh.Trimesh, *, longest_edge_mm: float = 4.0) -> trimesh.Trimesh:
        """A mesh of the undeformed implant's frame, bent and in its place in the world; long edges are split first."""
        return deformed_surface(self.warp, mesh, longest_edge_mm=longest_edge_mm)

    def motion_of(self, screw: Screw, nodes: Tensor | None = None) -> Tensor:
        """Rigid motion (4, 4) from the implant's frame to the world of a screw: as registered, or following its head.

        Args:
            screw: A screw of the registration, matched by name, or any other.
            nodes: Nodes (N, 3) of the undeformed implant, if the result has none.

        Raises:
            ValueError: If there are no nodes that a screw which was not registered could follow.
        """
        known = self.components.get(screw.name)
        if known is not None:
            return self.implant_to_world @ known.to(self.implant_to_world)
        points = self.cloud.points if nodes is None and self.cloud is not None else nodes
        if points is None:
            raise ValueError(f"screw {screw.name} was not registered, and there are no nodes of the implant to follow")
        head = self.implant_to_world.new_tensor(screw.start)
        return followed_motion(points, head, self.follow_radius_mm, self.warp)

    def known_components(
        self,
        mesh: trimesh.Trimesh | None = None,
        *,
        screws: Sequence[Screw] | None = None,
        material: str | None = None,
        pitch: float = 0.25,
    ) -> list[KnownComponent]:
        """The bent implant, then its screws, as known components in the world, for KC-Rec.

        Args:
            mesh: The undeformed implant, which makes its mask exact; without it, the registered nodes are taken.
            screws: Screws to use instead of the registration's; each unknown one follows the implant near its head.
            material: Material of the implant, if the registration had none.
            pitch: Pitch of the nodes made from meshes, mm.

        Raises:
            ValueError: If the implant's material is unknown, or there are neither mesh nor nodes.
        """
        name = material or self.material
        if name is None:
            raise ValueError(f"the {self.name} was registered without a material: name it")
        if mesh is not None:
            bent = KnownComponent.from_mesh(self.deformed(mesh, longest_edge_mm=_BENT_EDGE_MM), name, pitch=pitch)
            nodes = ImplantPointCloud.from_mesh(mesh, _NODES_PITCH_MM, dtype=torch.float64).points
        elif self.cloud is not None:
            nodes = self.cloud.points
            cell = self.cloud.cell.to(self.implant_to_world) @ self.implant_to_world[:3, :3].T
            points = self.warp(nodes)
            bent = KnownComponent(ImplantPointCloud(points.to(nodes), self.cloud.volumes, cell.to(nodes)), name)
        else:
            raise ValueError(f"the undeformed mesh of the {self.name} is needed: the result has no nodes")
        placed = []
        for screw in self.screws if screws is None else screws:
            motion = self.motion_of(screw, nodes)
            placed.append(screw.moved_by(motion))
        return [bent, *(KnownComponent.from_mesh(s.mesh(), s.material, pitch=pitch) for s in placed)]

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, for files.

        Raises:
            ValueError: If a parameter is not finite.
        """
        values = {"implant_to_world": self.implant_to_world, **dict(self.deformation.named_parameters())}
        values |= {f"motion of component {name}": motion for name, motion in self.components.items()}
        for name, value in values.items():
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"{name} must be finite to be written: the registration diverged")
        return {
            "name": self.name,
            "material": self.material,
            "implant_to_world": self.implant_to_world,
            "deformation": self.deformation.to_dict(),
            "components": dict(self.components),
            "screws": [screw.to_dict() for screw in self.screws],
            "found": list(self.found),
            "follow_radius_mm": self.follow_radius_mm,
            "deviations": None if self.deviations is None else self.deviations.to_dict(),
        }

    @classmethod
    def from_dict(cls, content: Any) -> RegisteredImplant:
        """The implant that `to_dict` wrote, in float64.

        Raises:
            ValueError: If a key is missing or malformed; the message names it.
        """
        require_keys(content, ("implant_to_world", "deformation"), " of an implant")
        try:
            screws = [Screw(**screw) for screw in content.get("screws", [])]
        except TypeError as error:
            raise ValueError(f"screws must have start, end, radius, material and name: {error}") from None
        return cls(
            name=str(content.get("name", "implant")),
            material=content.get("material"),
            implant_to_world=finite_array(content["implant_to_world"], (4, 4), "implant_to_world"),
            deformation=deformation_from_dict(content["deformation"]),
            components={
                name: finite_array(motion, (4, 4), f"motion of component {name}")
                for name, motion in content.get("components", {}).items()
            },
            screws=screws,
            found=[str(name) for name in content.get("found", [])],
            follow_radius_mm=float(content.get("follow_radius_mm", 8.0)),
            deviations=Deviations.from_dict(known) if (known := content.get("deviations")) is not None else None,
        )

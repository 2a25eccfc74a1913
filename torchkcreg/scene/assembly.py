"""An implant with its pose, its deformation and what is fixed to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchkcreg.deformation import Deformation
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points
from torchkcreg.implant import Component, Hole, ImplantPointCloud, Screw
from torchkcreg.precision import ExactModule

from .state import Placement

_FOLLOWED = 200  # nodes of the implant that tell a component its motion
_NODES_PITCH_MM = 2.0  # strain is smooth


class Assembly(ExactModule):
    """A known component of the paper, eq. 1: ``T(x) = implant_to_world (x + u(x))`` with x in the implant's frame.

    Components of it move rigidly, each with the rigid fit of the implant's motion near its head, and may be turned a
    little about their heads besides.

    Args:
        implant: Undeformed implant.
        deformation: Displacements u.
        implant_to_world: Pose (4, 4), rigid; the identity when None.
        material: The implant's material; components of the same material share its path length.
        components: Screws and the like, in the implant's frame.
        holes: The implant's holes, where screws that are not among the components may sit.
        follow_radius_mm: How near to a component's head the implant's nodes tell its motion, mm.
        name: How results refer to it.

    Attributes:
        found: Screws that were found in the holes; they are the components then.
        tilts: Rotation vectors (C, 3) of the components about their heads, in the implant's frame, radians.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ("implant_to_world", "tilts")
    implant: ImplantPointCloud
    deformation: Deformation
    components: Sequence[Component]
    implant_to_world: Tensor
    tilts: Tensor

    def __init__(
        self,
        implant: ImplantPointCloud,
        deformation: Deformation,
        *,
        implant_to_world: Tensor | None = None,
        material: str = "implant",
        components: Sequence[Component] = (),
        holes: Sequence[Hole] = (),
        follow_radius_mm: float = 8.0,
        name: str = "implant",
    ) -> None:
        super().__init__()
        self.implant, self.deformation = implant, deformation
        self.name, self.material, self.holes = name, material, list(holes)
        self.follow_radius_mm = follow_radius_mm
        device = implant.points.device
        still = torch.eye(4, dtype=torch.float64, device=device)
        pose = still if implant_to_world is None else implant_to_world.detach().clone()
        if pose.shape != (4, 4):
            raise ValueError(f"implant_to_world must have shape (4, 4), got {tuple(pose.shape)}")
        self.register_buffer("implant_to_world", pose.to(device, torch.float64))
        self.register_buffer("tilts", torch.zeros(0, 3, dtype=torch.float64, device=device), persistent=False)
        self.found: list[Screw] = []
        self.followed = implant.points.new_zeros(0, _FOLLOWED, 3, dtype=torch.float64)
        self._set_components(components)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Assembly:
        super()._apply(fn, recurse)
        self.followed = self.followed.to(self.implant_to_world.device)
        return self

    def place(self, screws: Sequence[Screw]) -> None:
        """Makes screws, with nodes as far apart as the implant's, the only components."""
        self.found = [replace(screw, name=f"found{index}") for index, screw in enumerate(screws)]
        self._set_components([Component.of(screw, pitch=self.implant.pitch) for screw in self.found])

    def _set_components(self, components: Sequence[Component]) -> None:
        device = self.implant.points.device
        self.components = nn.ModuleList(components).to(device)  # type: ignore[assignment]
        self.tilts = torch.zeros(len(components), 3, dtype=torch.float64, device=device)
        told = [followed_points(self.implant.points, c.head, self.follow_radius_mm) for c in components]
        self.followed = torch.stack([*told, self.implant.points.new_zeros(_FOLLOWED, 3).double()])[: len(told)]

    def bare(self) -> Assembly:
        """The implant alone; deformation and holes are shared."""
        return Assembly(
            self.implant,
            self.deformation,
            implant_to_world=self.implant_to_world,
            material=self.material,
            holes=self.holes,
            follow_radius_mm=self.follow_radius_mm,
            name=self.name,
        )

    @property
    def heads(self) -> Tensor:
        """Heads (C, 3) of the components in the implant's frame, float64."""
        return torch.stack([self.tilts.new_zeros(3), *(c.head.double() for c in self.components)])[1:]

    def warp(self, points: Tensor) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64."""
        flat = points.double().reshape(-1, 3)
        moved = flat + self.deformation.displacement(flat)
        return transform_points(self.implant_to_world, moved).reshape(points.shape)

    @torch.no_grad()
    def nodes(self, coarsening: int = 8) -> Tensor:
        """World positions (N, 3) of the implant's nodes on a lattice that many times coarser, mm."""
        return self.warp(self.implant.coarsened(coarsening).points)

    def placement(self, nodes: Tensor) -> Placement:
        """Where nodes (N, 3) of the implant's frame, and the components, are now, as one candidate."""
        poses = self.implant_to_world @ self._motions()
        return Placement(self.warp(nodes).to(nodes)[None], (poses @ rotation_about(self.heads, self.tilts))[None])

    def _motions(self) -> Tensor:
        """Rigid motions (C, 4, 4) of the components in the implant's frame."""
        moved = self.deformation(self.followed.flatten(0, 1)) if len(self.followed) else self.followed
        return fit_rigid(self.followed, moved.reshape(self.followed.shape))

    def motion_at(self, head: Tensor) -> Tensor:
        """Rigid motion (4, 4) in the implant's frame of a component whose head is there, a point (3,)."""
        return followed_motion(self.implant.points, head, self.follow_radius_mm, self.deformation)

    @torch.no_grad()
    def component_motions(self) -> dict[str, Tensor]:
        """Rigid motion (4, 4) of each component in the implant's frame."""
        turns = rotation_about(self.heads, self.tilts)
        return {c.name: m @ t for c, m, t in zip(self.components, self._motions(), turns, strict=True)}

    @torch.no_grad()
    def rms_strain(self) -> float:
        """Root mean square of the strain in the implant."""
        cloud = self.implant.coarsened_to(_NODES_PITCH_MM)
        gradients = self.deformation.strained(cloud.points.double())
        strain = 0.5 * (gradients.mT @ gradients - torch.eye(3, dtype=gradients.dtype, device=gradients.device))
        share = (cloud.volumes / cloud.volumes.sum()).double()
        return float((strain.square().sum((-2, -1)) * share).sum().sqrt())

    def kept(self) -> dict[str, Any]:
        """A copy of what a registration changes, as tensors and plain types, for :meth:`restore` and checkpoints."""
        return {
            "implant_to_world": self.implant_to_world.clone(),
            "deformation": {name: value.detach().clone() for name, value in self.deformation.state_dict().items()},
            "found": [screw.to_dict() for screw in self.found],
            "tilts": self.tilts.clone(),
        }

    @torch.no_grad()
    def restore(self, kept: dict[str, Any]) -> None:
        """Goes back to what :meth:`kept` gave."""
        self.implant_to_world.copy_(kept["implant_to_world"])
        self.deformation.load_state_dict(kept["deformation"])
        found = [Screw(**screw) for screw in kept["found"]]
        if self.found != found:
            self.place(found)
        self.tilts = kept["tilts"].clone().to(self.implant_to_world)

    def description(self) -> dict[str, list[float]]:
        """What tells it from another implant, deformation or components, as plain numbers."""
        points = self.implant.points.double()
        bounds = torch.cat([points.amin(0), points.amax(0)])
        return {
            "the implant's nodes": [len(points), round(float(self.implant.volumes.double().sum()), 3)],
            "the implant's bounds": [round(x, 3) for x in bounds.tolist()],
            "the deformation": [round(x, 3) for x in self.deformation.description()],
            "the heads of components": [] if self.found else [round(x, 3) for x in self.heads.flatten().tolist()],
        }

    def extra_repr(self) -> str:
        """Name, material and what is fixed to it."""
        return f"name={self.name!r}, material={self.material!r}, components={len(self.components)}"


def followed_motion(points: Tensor, head: Tensor, radius: float, moved: Callable[[Tensor], Tensor]) -> Tensor:
    """Rigid motion (4, 4) of a part whose head is fixed to an implant of points (N, 3) that something moves."""
    followed = followed_points(points, head, radius)
    return fit_rigid(followed, moved(followed))


def followed_points(points: Tensor, head: Tensor, radius: float) -> Tensor:
    """The implant's points (200, 3), float64, near a component's head that tell how it moves; some repeated if few."""
    distance = torch.linalg.vector_norm(points - head.to(points), dim=-1)
    near = (distance <= torch.clamp(distance.min() * 1.5, min=radius)).nonzero().flatten()
    chosen = torch.arange(_FOLLOWED, device=points.device) * len(near) // _FOLLOWED
    return points[near[chosen]].double()

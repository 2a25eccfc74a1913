"""An implant with its pose, its deformation and its components, and the motion of components with the implant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchkcreg.deformation import Deformation
from torchkcreg.geometry import fit_rigid, rigid_matrix, rotation_about, transform_points
from torchkcreg.implant import Component, Hole, ImplantPointCloud, Screw
from torchkcreg.precision import ExactModule

from .state import Placement

_FOLLOWED = 200  # nodes of the implant that determine a component's motion
_NODES_PITCH_MM = 2.0  # strain is smooth


class Assembly(ExactModule):
    """A known component of the paper, eq. 1: `T(x) = implant_to_world (x + u(x))` with x in the implant's frame.

    Components move rigidly, each with the rigid fit of the implant's motion near its head. They may also tilt a little
    about their heads.

    Args:
        implant: Undeformed implant.
        deformation: Displacements u.
        implant_to_world: Pose (4, 4), rigid; the identity when None.
        material: The implant's material; components of the same material share its path length.
        components: Screws and other parts that are fixed to it, in the implant's frame.
        holes: The implant's holes, where screws may be searched for.
        follow_radius_mm: A component follows the implant's nodes within this distance of its head, mm.
        name: How results refer to it.

    The pose is `start_pose M(twist)` with the buffer `start_pose` and the parameter `twist`, so any torch
    optimiser can move the implant; assign to `implant_to_world` to set the pose.

    Attributes:
        twist: Parameter (6,), mm: rotation vector about the implant's centre of mass times its radius of gyration, then
            a translation. Zero after the pose has been set.
        found: Screws that were found in the holes; if any, they are the components.
        tilts: Rotation vectors (C, 3) of the components about their heads, in the implant's frame, radians.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ("start_pose", "middle", "tilts")
    implant: ImplantPointCloud
    deformation: Deformation
    components: Sequence[Component]
    start_pose: Tensor
    middle: Tensor
    tilts: Tensor

    def __init__(
        self,
        implant: ImplantPointCloud,
        deformation: Deformation,
        *,
        implant_to_world: Tensor | None = None,
        material: str = "implant",
        components: Sequence[Component | Screw] = (),
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
        self.register_buffer("start_pose", pose.to(device, torch.float64))
        middle, radius = implant.gyration()
        self.radius_mm = float(radius)
        self.register_buffer("middle", middle, persistent=False)
        self.twist = nn.Parameter(torch.zeros(6, dtype=torch.float64, device=device))
        self.register_buffer("tilts", torch.zeros(0, 3, dtype=torch.float64, device=device), persistent=False)
        self.found: list[Screw] = []
        self.followed = implant.points.new_zeros(0, _FOLLOWED, 3, dtype=torch.float64)
        self._set_components(components)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Assembly:
        twist = self.twist.detach()
        super()._apply(fn, recurse)
        if self.twist.dtype != twist.dtype:  # as exact as the pose
            self.twist.data = twist.to(self.twist.device)
        self.followed = self.followed.to(self.twist.device)
        return self

    @property
    def implant_to_world(self) -> Tensor:
        """Pose (4, 4), rigid, float64, differentiable in the twist."""
        turn, shift = self.twist[:3] / self.radius_mm, self.twist[3:]
        return self.start_pose @ rigid_matrix(torch.zeros_like(shift), shift) @ rotation_about(self.middle, turn)

    @implant_to_world.setter
    def implant_to_world(self, pose: Tensor) -> None:
        with torch.no_grad():
            self.start_pose.copy_(pose)
            self.twist.zero_()

    def place(self, screws: Sequence[Screw]) -> None:
        """Replace all components by found screws, with the implant's node pitch."""
        self.found = [replace(screw, name=f"found{index}") for index, screw in enumerate(screws)]
        self._set_components(self.found)

    def _set_components(self, parts: Sequence[Component | Screw]) -> None:
        device, pitch = self.implant.points.device, self.implant.pitch
        components = [part if isinstance(part, Component) else Component.of(part, pitch=pitch) for part in parts]
        self.components = nn.ModuleList(components).to(device)  # type: ignore[assignment]
        self.tilts = torch.zeros(len(components), 3, dtype=torch.float64, device=device)
        followed = [followed_points(self.implant.points, c.head, self.follow_radius_mm) for c in components]
        self.followed = torch.stack([*followed, self.implant.points.new_zeros(_FOLLOWED, 3).double()])[: len(followed)]

    def bare(self) -> Assembly:
        """The implant alone; deformation and holes are shared."""
        return Assembly(
            self.implant,
            self.deformation,
            implant_to_world=self.implant_to_world.detach(),
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
        """World positions (N, 3) of the implant's nodes on a lattice coarser by this factor, mm."""
        return self.warp(self.implant.coarsened(coarsening).points)

    def placement(self, nodes: Tensor) -> Placement:
        """Present placement of nodes (N, 3) of the implant's frame and of the components, as one candidate."""
        poses = self.implant_to_world @ self._motions()
        return Placement(self.warp(nodes).to(nodes)[None], (poses @ rotation_about(self.heads, self.tilts))[None])

    def _motions(self) -> Tensor:
        """Rigid motions (C, 4, 4) of the components in the implant's frame."""
        moved = self.deformation(self.followed.flatten(0, 1)) if len(self.followed) else self.followed
        return fit_rigid(self.followed, moved.reshape(self.followed.shape))

    def motion_at(self, head: Tensor) -> Tensor:
        """Rigid motion (4, 4), in the implant's frame, of a component with its head at a point (3,)."""
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
        """Copy of all that a registration changes, as tensors and plain types, for `restore` and checkpoints."""
        return {
            "implant_to_world": self.implant_to_world.detach().clone(),
            "deformation": {name: value.detach().clone() for name, value in self.deformation.state_dict().items()},
            "found": [screw.to_dict() for screw in self.found],
            "tilts": self.tilts.clone(),
        }

    @torch.no_grad()
    def restore(self, kept: dict[str, Any]) -> None:
        """Restore a state that `kept` returned."""
        self.implant_to_world = kept["implant_to_world"]
        self.deformation.load_state_dict(kept["deformation"])
        screws = [Screw(**screw) for screw in kept["found"]]
        if self.found != screws:
            self.place(screws)
        self.tilts = kept["tilts"].clone().to(self.start_pose)

    def description(self) -> dict[str, list[float]]:
        """Numbers that identify implant, deformation and components, to check that a checkpoint belongs to them."""
        points = self.implant.points.double()
        bounds = torch.cat([points.amin(0), points.amax(0)])
        return {
            "the implant's nodes": [len(points), round(float(self.implant.volumes.double().sum()), 3)],
            "the implant's bounds": [round(x, 3) for x in bounds.tolist()],
            "the deformation": [round(x, 3) for x in self.deformation.description()],
            "the heads of components": [] if self.found else [round(x, 3) for x in self.heads.flatten().tolist()],
        }

    def extra_repr(self) -> str:
        """Name, material and number of components."""
        return f"name={self.name!r}, material={self.material!r}, components={len(self.components)}"


def followed_motion(points: Tensor, head: Tensor, radius: float, moved: Callable[[Tensor], Tensor]) -> Tensor:
    """Rigid motion (4, 4) of a part whose head is fixed to an implant of points (N, 3) that `moved` displaces."""
    followed = followed_points(points, head, radius)
    return fit_rigid(followed, moved(followed))


def followed_points(points: Tensor, head: Tensor, radius: float) -> Tensor:
    """Implant points (200, 3), float64, near a head, which determine a component's motion; repeated if fewer."""
    distance = torch.linalg.vector_norm(points - head.to(points), dim=-1)
    near = (distance <= torch.clamp(distance.min() * 1.5, min=radius)).nonzero().flatten()
    chosen = torch.arange(_FOLLOWED, device=points.device) * len(near) // _FOLLOWED
    return points[near[chosen]].double()

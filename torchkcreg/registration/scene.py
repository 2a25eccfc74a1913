"""What a DRR is made of: the implant, how it moves, the components that follow it, and the intensity model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchkcreg.deformation import FreeFormDeformation
from torchkcreg.geometry import fit_rigid
from torchkcreg.implant import Component, ImplantPointCloud


class Scene(nn.Module):
    """An implant with its pose, deformation, components and intensity model.

    ``T(x) = implant_to_world (x + u(x))`` (eq. 1) with x in the implant's frame. A component moves rigidly, with the
    rigid fit of the implant's motion near its head.

    Args:
        implant: Undeformed implant.
        deformation: Free-form deformation around it.
        intensity: Path lengths of M materials to line integrals.
        implant_to_world: Start pose (4, 4), rigid.
        components: Screws and the like, in the implant's frame.
        material: The implant's material; components of the same material share its path length.
        follow_radius_mm: How near to a component's head the implant's nodes tell its motion, mm.
    """

    implant_to_world: Tensor

    def __init__(
        self,
        implant: ImplantPointCloud,
        deformation: FreeFormDeformation,
        intensity: nn.Module,
        implant_to_world: Tensor,
        *,
        components: Sequence[Component] = (),
        material: str = "implant",
        follow_radius_mm: float = 8.0,
    ) -> None:
        super().__init__()
        self.implant = implant
        self.deformation = deformation
        self.intensity = intensity
        self.components = list(components)
        self.material = material
        self.register_buffer("implant_to_world", implant_to_world.double().clone())
        self.followed = [followed_points(implant.points, c.head, follow_radius_mm) for c in self.components]

    @property
    def materials(self) -> list[str]:
        """Names of the materials in the order of the path lengths, the implant's first."""
        return list(dict.fromkeys([self.material, *(c.material for c in self.components)]))

    @property
    def is_polyenergetic(self) -> bool:
        """Whether the intensity model has materials; it then has the background as its last one."""
        return hasattr(self.intensity, "scatter")

    @property
    def num_groups(self) -> int:
        """Groups of control points that the deformation has been split into so far."""
        return int(self.deformation.labels.max()) + 1

    @torch.no_grad()
    def component_motions(self) -> dict[str, Tensor]:
        """Rigid motion (4, 4) of each component in the implant's frame."""
        motions = {}
        for component, points in zip(self.components, self.followed, strict=True):
            points = points.double()
            motions[component.name] = fit_rigid(points, points + self.deformation.displacement(points))
        return motions


def followed_points(points: Tensor, head: Tensor, radius: float, at_most: int = 200) -> Tensor:
    """The implant's points (n, 3) near a component's head that tell how it moves, thinned to ``at_most``."""
    distance = torch.linalg.vector_norm(points - head.to(points), dim=-1)
    near = (distance <= torch.clamp(distance.min() * 1.5, min=radius)).nonzero().flatten()
    stride = max(1, len(near) // at_most)
    return points[near[::stride]]

"""What a DRR is made of: the implant, how it moves, the components that follow it, and the intensity model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchkcreg.deformation import FreeFormDeformation
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points
from torchkcreg.implant import Component, Hole, ImplantPointCloud

from .found_screw import FoundScrew


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
        holes: The implant's holes, where screws that are not among the components may sit.
        metals: Names of the materials that screws found there may be of, besides the implant's own.
        knows_spectrum: Whether the intensity model's spectrum is the scanner's own, not a likely one.
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
        holes: Sequence[Hole] = (),
        metals: Sequence[str] = (),
        knows_spectrum: bool = True,
    ) -> None:
        super().__init__()
        self.implant = implant
        self.deformation = deformation
        self.intensity = intensity
        self.material = material
        self.follow_radius_mm = follow_radius_mm
        self.holes = list(holes)
        self.metals = list(metals)
        self.knows_spectrum = knows_spectrum
        self.register_buffer("implant_to_world", implant_to_world.double().clone())
        self.found: list[FoundScrew] = []
        self._set_components(components)

    def place(self, screws: Sequence[FoundScrew], pitch: float) -> None:
        """Makes screws, nodes ``pitch`` mm apart, the only components."""
        self.found = list(screws)
        names = [f"found{index}" for index in range(len(screws))]
        self._set_components([s.component(n, pitch) for n, s in zip(names, screws, strict=True)])

    def _set_components(self, components: Sequence[Component]) -> None:
        self.components = list(components)
        self.heads = torch.tensor([c.head.tolist() for c in components], dtype=torch.float64).reshape(-1, 3)
        self.tilts = torch.zeros_like(self.heads)
        self.followed = [followed_points(self.implant.points, c.head, self.follow_radius_mm) for c in self.components]

    def without_components(self) -> Scene:
        """The implant alone, sharing everything with this scene."""
        bare = Scene(
            self.implant,
            self.deformation,
            self.intensity,
            self.implant_to_world,
            material=self.material,
            follow_radius_mm=self.follow_radius_mm,
            holes=self.holes,
            metals=list(dict.fromkeys([*self.metals, *(c.material for c in self.components)])),
            knows_spectrum=self.knows_spectrum,
        )
        bare.implant_to_world = self.implant_to_world
        return bare

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Scene:
        exact = self.implant_to_world
        super()._apply(fn, recurse)
        self.implant_to_world = exact.to(self.implant_to_world.device)  # follow .to(device), but not .float()
        return self

    def description(self) -> dict[str, list[float]]:
        """What tells this registration from one of another implant, grid or components, as plain numbers."""
        points, grid = self.implant.points.double(), self.deformation.grid
        bounds = torch.cat([points.amin(0), points.amax(0)])
        return {
            "the implant's nodes": [len(points), round(float(self.implant.masses.double().sum()), 3)],
            "the implant's bounds": [round(x, 3) for x in bounds.tolist()],
            "the grid's shape": [float(n) for n in grid.shape],
            "the grid's frame": [round(x, 3) for x in (*grid.spacing, *grid.frame.flatten().tolist())],
            "the intensity model": [len(list(self.intensity.parameters()))],
            "the heads of components": [] if self.found else [round(x, 3) for x in self.heads.flatten().tolist()],
        }

    @torch.no_grad()
    def motion_at(self, head: Sequence[float]) -> Tensor:
        """Rigid motion (4, 4) in the implant's frame of a component whose head is there, a point (3,)."""
        points = followed_points(self.implant.points, torch.tensor(head), self.follow_radius_mm).double()
        return fit_rigid(points, points + self.deformation.displacement(points))

    @property
    def materials(self) -> list[str]:
        """Names of the materials in the order of the path lengths, the implant's first."""
        return list(dict.fromkeys([self.material, *self.metals, *(c.material for c in self.components)]))

    @property
    def is_polyenergetic(self) -> bool:
        """Whether the intensity model has materials; it then has the background as its last one."""
        return hasattr(self.intensity, "scatter")

    @property
    def num_groups(self) -> int:
        """Groups of control points that the deformation has been split into so far."""
        return int(self.deformation.labels.max()) + 1

    def moving_state(self) -> dict[str, Tensor]:
        """A copy of what a registration changes: pose, deformation, parameters of the intensity model."""
        state = self.state_dict()
        return {name: value.clone() for name, value in state.items() if not name.startswith("implant.")}

    def kept(self) -> tuple[dict[str, Tensor], list[FoundScrew], Tensor]:
        """What :meth:`restore` goes back to."""
        return self.moving_state(), list(self.found), self.tilts.clone()

    def restore(self, kept: tuple[dict[str, Tensor], list[FoundScrew], Tensor], pitch: float) -> None:
        """Goes back to a state, nodes of found screws ``pitch`` mm apart."""
        state, found, tilts = kept
        self.load_state_dict(state, strict=False)
        if self.found != found:
            self.place(found, pitch)
        self.tilts = tilts.clone()

    @torch.no_grad()
    def nodes(self, coarsening: int = 8) -> Tensor:
        """World positions (N, 3) of the implant's nodes on a lattice that many times coarser, mm."""
        points = self.implant.coarsened(coarsening).points.double()
        return transform_points(self.implant_to_world, points + self.deformation.displacement(points))

    @torch.no_grad()
    def component_motions(self) -> dict[str, Tensor]:
        """Rigid motion (4, 4) of each component in the implant's frame."""
        turns = rotation_about(self.heads, self.tilts)
        return {c.name: self.motion_at(c.head.tolist()) @ t for c, t in zip(self.components, turns, strict=True)}


def followed_points(points: Tensor, head: Tensor, radius: float, at_most: int = 200) -> Tensor:
    """The implant's points (n, 3) near a component's head that tell how it moves, thinned to ``at_most``."""
    distance = torch.linalg.vector_norm(points - head.to(points), dim=-1)
    near = (distance <= torch.clamp(distance.min() * 1.5, min=radius)).nonzero().flatten()
    stride = max(1, len(near) // at_most)
    return points[near[::stride]]

"""Several implants as a registration left them, of which the first is meant where none is named."""

from __future__ import annotations

from collections.abc import Mapping

import trimesh
from torch import Tensor

from torchkcreg.deformation import Deformation
from torchkcreg.implant import Screw
from torchkcreg.scene import KnownComponent

from .registered_implant import RegisteredImplant


class RegisteredImplants:
    """What can be asked of registered implants; :class:`RegistrationResult` holds them."""

    implants: list[RegisteredImplant]

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
    def screws_found(self) -> list[Screw]:
        """Screws that were found, not given, each in its implant's frame before the motion."""
        return [screw for implant in self.implants for screw in implant.screws if screw.name in implant.found]

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

    def deformed(
        self, mesh: trimesh.Trimesh, *, implant: str | None = None, longest_edge_mm: float = 4.0
    ) -> trimesh.Trimesh:
        """A mesh of the undeformed implant's frame, bent and in its place in the world; long edges are split first."""
        return self.implant(implant).deformed(mesh, longest_edge_mm=longest_edge_mm)

    def known_components(
        self, meshes: trimesh.Trimesh | Mapping[str, trimesh.Trimesh] | None = None, *, pitch: float = 0.25
    ) -> list[KnownComponent]:
        """The bent implants and their screws as metal in its place: what KC-Rec takes.

        Args:
            meshes: Undeformed implant, or one a name; they make masks exact. Without, registered nodes are taken.
            pitch: Of the nodes made of meshes, mm.

        Raises:
            ValueError: If nothing says what an implant is made of, or there is neither mesh nor node.
        """
        named = {self.implants[0].name: meshes} if isinstance(meshes, trimesh.Trimesh) else dict(meshes or {})
        return [part for i in self.implants for part in i.known_components(named.get(i.name), pitch=pitch)]

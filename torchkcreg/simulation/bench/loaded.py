"""A specimen under a load: where its implant, its fragments, screws and beads go."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import FiniteElementDeformation
from torchkcreg.geometry import fit_rigid, rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import CarriedLoad, Superelement, holds_of, von_mises
from torchkcreg.physics import elastic_constants
from torchkcreg.simulation.elastic import hold_motions, rigid_at
from torchkcreg.simulation.hardware import mapped
from torchkcreg.simulation.loads import Load

from .recipe import LoadRecipe
from .specimen import DISTAL, PROXIMAL, Specimen

_PITCH_MM = 0.4  # of the finite elements' nodes, or less: a tenth of the implant's thickness
_NEAR_MM = 8.0  # of a screw's head: the implant there tells how it moves
_HIGHEST = 0.99  # quantile that a plate's highest stresses are: beside holes they peak
_TURN_MM = 20.0  # by which turns and shifts weigh alike


@dataclass(frozen=True, eq=False)
class Loaded:
    """Where a load takes a specimen.

    Attributes:
        implant: Maps points (..., 3) of the undeformed implant.
        fragments: Rigid motion (4, 4) of each.
        screws: Rigid motion (4, 4) of each.
        carried: What the implant carries, where a force bends it.
    """

    implant: Callable[[Tensor], Tensor]
    fragments: dict[str, Tensor]
    screws: list[Tensor]
    carried: CarriedLoad | None = None

    def mesh(self, undeformed: trimesh.Trimesh) -> trimesh.Trimesh:
        """The implant's mesh under load."""
        return mapped(undeformed, self.implant)


class ElasticConstruct:
    """An implant on screws that are rigid in two rigid fragments: how it bends under forces on the proximal one.

    Small strains, finite rotations; the arm of a force does not change as the implant bends.

    Args:
        specimen: With screws in both fragments.

    Raises:
        ValueError: If a fragment has no screw, or the implant's elastic constants are not known.
    """

    def __init__(self, specimen: Specimen) -> None:
        self.specimen, sides = specimen, {}
        constants = elastic_constants(specimen.recipe.implant.material)
        pitch = min(_PITCH_MM, float(specimen.implant.extents.min()) / 10)
        cloud = ImplantPointCloud.from_mesh(specimen.implant, pitch)
        holds = holds_of(cloud, specimen.holes)
        self.element = Superelement.of(cloud, constants, holds, negligible_mm=0.0)
        places = torch.tensor([hold.center for hold in holds], dtype=torch.float64, device="cpu")
        for screw in specimen.screws:
            head = torch.tensor(screw.start, dtype=torch.float64, device="cpu")
            sides[int((places - head).norm(dim=1).argmin())] = specimen.fragment_of(screw.start[2])
        missing = {DISTAL, PROXIMAL} - set(sides.values())
        if missing:
            raise ValueError(f"a force needs screws in both fragments, the {missing.pop()} one has none")
        self.places, self.sides = places, sides

    def amounts(self, force: Tensor, at: Tensor) -> Tensor:
        """Amounts (A,) for which each fragment's holds move as one body and the proximal ones take a force.

        Holds without a screw carry nothing; the fragments' motions are unknowns, too.

        Args:
            force: (3,), N.
            at: Where it acts on the proximal fragment, (3,), mm.
        """
        element, number = self.element, self.element.num_amounts
        loads, used = element.loads, sorted(self.sides)
        alike = loads.new_tensor([1.0] * 3 + [_TURN_MM] * 3)
        held = (hold_motions(element, used) * alike).flatten(1)  # (A, 6 U)
        rigid = held.new_zeros(6 * len(used), 12)
        for row, hold in enumerate(used):
            first = 6 if self.sides[hold] == PROXIMAL else 0
            rigid[6 * row : 6 * row + 6, first : first + 6] = -alike[:, None] * rigid_at(self.places[hold])
        proximal = [hold for hold in used if self.sides[hold] == PROXIMAL]
        arms = (self.places[proximal] - at).expand(number, -1, 3)
        moments = loads[:, proximal, 3:] + torch.linalg.cross(arms, loads[:, proximal, :3])
        wrench = torch.cat([loads[:, proximal, :3].sum(1), moments.sum(1) / _TURN_MM], dim=1)  # (A, 6)
        free = [hold for hold in range(len(self.places)) if hold not in self.sides]
        idle = loads[:, free] / alike
        compliance = float(held.abs().max() / loads.abs().max())  # mm/N: so that rows weigh alike
        known = torch.cat([wrench, idle.flatten(1)], dim=1).T * compliance
        rows = torch.cat([torch.cat([held.T, rigid], dim=1), torch.cat([known, known.new_zeros(len(known), 12)], 1)])
        right = rows.new_zeros(len(rows))
        right[6 * len(used) : 6 * len(used) + 3] = force * compliance
        return torch.linalg.lstsq(rows, right[:, None], driver="gelsd").solution[:number, 0]

    def loaded(self, recipe: LoadRecipe) -> Loaded:
        """Where a force takes the specimen; the distal fragment stays, but for the pose."""
        bone = self.specimen.recipe.limb.bone
        middle = (0.0, 0.0) if bone is None else bone.axis[:2]
        at = torch.tensor(recipe.at or (*middle, self.specimen.fracture), dtype=torch.float64, device="cpu")
        force = torch.tensor(recipe.force, dtype=torch.float64, device="cpu")
        amounts = self.amounts(force, at)
        self._check_strength(amounts)
        deformation = FiniteElementDeformation(self.element, amounts)
        with torch.no_grad():
            moved = {side: fit_rigid(held, deformation(held)) for side, held in self._held().items()}
        pose = pose_of(recipe) @ torch.linalg.inv(moved[DISTAL])

        @torch.no_grad()
        def motion(points: Tensor) -> Tensor:
            exact = points.double().reshape(-1, 3)
            return transform_points(pose, deformation(exact)).reshape(points.shape).to(points)

        fragments = {side: pose @ motion_of for side, motion_of in moved.items()}
        screws = [fragments[self.specimen.fragment_of(screw.start[2])] for screw in self.specimen.screws]
        return Loaded(motion, fragments, screws, CarriedLoad.of(self.element, amounts))

    def _held(self) -> dict[str, Tensor]:
        """Points (n, 3) of the implant that each fragment's screws hold."""
        where = transform_points(self.element.hexahedra.frame, self.element.hexahedra.positions)
        return {
            side: torch.cat([where[_hold_nodes(self.element, hold)] for hold, own in self.sides.items() if own == side])
            for side in (DISTAL, PROXIMAL)
        }

    def _check_strength(self, amounts: Tensor) -> None:
        surface = torch.from_numpy(np.array(self.specimen.implant.vertices))
        stress = float(von_mises(self.element.stress(surface, amounts)).quantile(_HIGHEST))
        bears = self.element.constants.yield_stress
        if stress > bears:
            alloy = self.specimen.recipe.implant.material
            warnings.warn(
                f"the implant is stressed to {stress:.0f} N/mm^2: {alloy} yields at {bears:.0f}", stacklevel=4
            )


def pose_of(recipe: LoadRecipe) -> Tensor:
    """Where the whole stands (4, 4)."""
    turn = torch.deg2rad(torch.tensor(recipe.rotation, dtype=torch.float64, device="cpu"))
    return rigid_matrix(turn, torch.tensor(recipe.translation, dtype=torch.float64, device="cpu"))


def loaded(specimen: Specimen, recipe: LoadRecipe, construct: ElasticConstruct | None = None) -> Loaded:
    """Where a load takes a specimen.

    Args:
        specimen: Without load.
        recipe: The load.
        construct: Of the specimen, where it has been made already: making it takes seconds.

    Raises:
        ValueError: As `ElasticConstruct` and `Load` do.
    """
    if any(recipe.force):
        return (construct or ElasticConstruct(specimen)).loaded(recipe)
    pose = pose_of(recipe)
    if not recipe.bent:
        return _of_motion(
            specimen, lambda points: transform_points(pose, points.double().reshape(-1, 3)).reshape(points.shape)
        )
    load = Load(
        bend_deg=recipe.bend,
        lateral_deg=recipe.lateral,
        torsion_deg=recipe.torsion,
        s_bend_deg=recipe.s_bend,
        zone_mm=recipe.zone,
        length_mm=float(np.ptp(specimen.implant.vertices[:, 2])),
        rotation_deg=recipe.rotation,
        translation_mm=recipe.translation,
    )
    return _of_motion(specimen, load.motion())


def _of_motion(specimen: Specimen, motion: Callable[[Tensor], Tensor]) -> Loaded:
    """The specimen's other parts, which go as the implant does beside their screws."""
    vertices = torch.from_numpy(np.array(specimen.implant.vertices))
    moved = motion(vertices)
    near: dict[str, list[Tensor]] = {DISTAL: [], PROXIMAL: []}
    screws = []
    for screw in specimen.screws:
        away = (vertices - torch.tensor(screw.start, dtype=torch.float64, device="cpu")).norm(dim=1)
        beside = (away <= max(_NEAR_MM, float(away.sort().values[min(8, len(away) - 1)]))).nonzero().flatten()
        screws.append(fit_rigid(vertices[beside], moved[beside]))
        near[specimen.fragment_of(screw.start[2])].append(beside)
    whole = fit_rigid(vertices, moved)
    fragments = {
        name: fit_rigid(vertices[torch.cat(places)], moved[torch.cat(places)]) if places else whole
        for name, places in near.items()
    }
    return Loaded(motion, fragments, screws)


def _hold_nodes(element: Superelement, hold: int) -> Tensor:
    return element.holds[hold].nodes(transform_points(element.hexahedra.frame, element.hexahedra.positions))

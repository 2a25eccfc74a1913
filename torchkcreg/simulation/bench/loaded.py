"""A specimen under load: the motion of its implant, bone fragments, screws and beads."""

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
from torchkcreg.implant import ImplantPointCloud, Screw
from torchkcreg.mechanics import CarriedLoad, Superelement, hold_motions, holds_of, rigid_at, von_mises
from torchkcreg.physics import elastic_constants
from torchkcreg.simulation.hardware import mapped
from torchkcreg.simulation.loads import Load

from .recipe import LoadRecipe
from .specimen import DISTAL, PROXIMAL, Specimen

_PITCH_MM = 0.4  # largest node spacing of the finite elements; less if a tenth of the implant's thickness is less
_NEAR_MM = 8.0  # the screw follows the implant's vertices within this distance of its head
_HIGHEST = 0.99  # quantile taken as the highest stress: the maximum itself is a peak beside a hole
_TISSUE_POISSON = 0.3
_TURN_MM = 20.0  # lever arm that makes rotations and translations comparable


@dataclass(frozen=True, eq=False)
class Loaded:
    """Motion of a specimen's parts under a load.

    Attributes:
        implant: Maps points (..., 3) of the undeformed implant to their loaded positions.
        fragments: Rigid motion (4, 4) of each bone fragment, by name.
        screws: Rigid motion (4, 4) of each screw.
        carried: Load carried by the implant; None unless a force bends it.
    """

    implant: Callable[[Tensor], Tensor]
    fragments: dict[str, Tensor]
    screws: list[Tensor]
    carried: CarriedLoad | None = None

    def mesh(self, undeformed: trimesh.Trimesh) -> trimesh.Trimesh:
        """The implant's mesh under load."""
        return mapped(undeformed, self.implant)


class ElasticConstruct:
    """Elastic implant on two rigid bone fragments, bent by a force on the proximal fragment.

    The screws are rigidly fixed in the fragments. Small strains, finite rotations; the lever arm of a force does not
    change as the implant bends.

    Args:
        specimen: Specimen with screws in both fragments.

    Raises:
        ValueError: If a fragment has no screw, or the implant material's elastic constants are not available.
    """

    def __init__(self, specimen: Specimen) -> None:
        self.specimen, sides = specimen, {}
        constants = elastic_constants(specimen.recipe.implant.material)
        pitch = min(_PITCH_MM, float(specimen.implant.extents.min()) / 10)
        cloud = ImplantPointCloud.from_mesh(specimen.implant, pitch)
        holds = holds_of(cloud, specimen.holes)
        self.element = Superelement.of(cloud, constants, holds, negligible_mm=0.0)
        places = torch.tensor([hold.center for hold in holds], dtype=torch.float64, device="cpu")
        for number, screw in enumerate(specimen.screws):
            if not specimen.holds(number):
                continue
            head = torch.tensor(screw.start, dtype=torch.float64, device="cpu")
            sides[int((places - head).norm(dim=1).argmin())] = specimen.fragment_of(screw.start[2])
        missing = {DISTAL, PROXIMAL} - set(sides.values())
        if missing:
            raise ValueError(f"a force needs screws in both fragments, the {missing.pop()} one has none")
        self.places, self.sides = places, sides

    def amounts(self, force: Tensor, at: Tensor) -> Tensor:
        """Deformation amounts (A,) of the superelement under a force on the proximal fragment.

        The holds (screw seats) of each fragment move as one rigid body, and those of the proximal one take the force.
        Holds without a screw carry no load. The motions of the fragments are unknowns of the same linear system.

        Args:
            force: Force (3,), N.
            at: Point (3,) of the proximal fragment where the force acts, mm.
        """
        element, number = self.element, self.element.num_amounts
        loads, used = element.loads, sorted(self.sides)
        scale = loads.new_tensor([1.0] * 3 + [_TURN_MM] * 3)
        seats = [element.holds[hold] for hold in used]
        held = (hold_motions(element.hexahedra, element.nodal, seats) * scale).flatten(1)  # (A, 6 U)
        rigid = held.new_zeros(6 * len(used), 12)
        for row, hold in enumerate(used):
            first = 6 if self.sides[hold] == PROXIMAL else 0
            rigid[6 * row : 6 * row + 6, first : first + 6] = -scale[:, None] * rigid_at(self.places[hold])
        proximal = [hold for hold in used if self.sides[hold] == PROXIMAL]
        arms = (self.places[proximal] - at).expand(number, -1, 3)
        moments = loads[:, proximal, 3:] + torch.linalg.cross(arms, loads[:, proximal, :3])
        wrench = torch.cat([loads[:, proximal, :3].sum(1), moments.sum(1) / _TURN_MM], dim=1)  # (A, 6)
        free = [hold for hold in range(len(self.places)) if hold not in self.sides]
        idle = loads[:, free] / scale
        compliance = float(held.abs().max() / loads.abs().max())  # mm/N: gives all rows the same scale
        known = torch.cat([wrench, idle.flatten(1)], dim=1).T * compliance
        shared = known.new_zeros(len(known), 12)
        shared[:6] = self._callus_wrench(at) * compliance
        rows = torch.cat([torch.cat([held.T, rigid], dim=1), torch.cat([known, shared], 1)])
        right_hand_side = rows.new_zeros(len(rows))
        right_hand_side[6 * len(used) : 6 * len(used) + 3] = force * compliance
        return torch.linalg.lstsq(rows, right_hand_side[:, None], driver="gelsd").solution[:number, 0]

    def _callus_wrench(self, at: Tensor) -> Tensor:
        """Force, and moment about a point (3,) over the lever arm, through the callus, (6, 12), per fragment's motion.

        The callus is a short column as wide as the cortex: of axial stiffness k, it has a shear stiffness of k G / E, a
        bending stiffness of k I / A and a torsional one of k G J / (E A).
        """
        bone = self.specimen.recipe.limb.bone
        wrench = torch.zeros(6, 12, dtype=torch.float64, device="cpu")
        if bone is None or bone.callus == 0:
            return wrench
        center = torch.tensor([*bone.axis[:2], self.specimen.fracture], dtype=torch.float64, device="cpu")
        spread = (bone.outer_radius**2 + bone.inner_radius**2) / 4  # I / A of a ring
        shear = 1 / (2 * (1 + _TISSUE_POISSON))
        stiffness = bone.callus * center.new_tensor([shear, shear, 1.0, spread, spread, 2 * shear * spread])
        relative = stiffness[:, None] * rigid_at(center)
        turned = relative[3:] + torch.linalg.cross((center - at).expand(6, 3), relative[:3].T).T
        through = torch.cat([relative[:3], turned / _TURN_MM])
        return torch.cat([-through, through], dim=1)

    def loaded(self, recipe: LoadRecipe) -> Loaded:
        """Motion of the specimen under a force. The distal fragment moves only by the recipe's pose."""
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
        if loose := self.specimen.recipe.screws.loose:
            surface = torch.from_numpy(np.array(self.specimen.implant.vertices))
            moved_surface = motion(surface)
            for number in loose:
                screws[number] = _near_motion(surface, moved_surface, self.specimen.screws[number])[0]
        return Loaded(motion, fragments, screws, CarriedLoad.of(self.element, amounts))

    def _held(self) -> dict[str, Tensor]:
        """Points (n, 3) of the implant held by the screws of each fragment."""
        nodes = transform_points(self.element.hexahedra.frame, self.element.hexahedra.positions)
        return {
            side: torch.cat(
                [nodes[_hold_nodes(self.element, hold)] for hold, hold_side in self.sides.items() if hold_side == side]
            )
            for side in (DISTAL, PROXIMAL)
        }

    def _check_strength(self, amounts: Tensor) -> None:
        surface = torch.from_numpy(np.array(self.specimen.implant.vertices))
        stress = float(von_mises(self.element.stress(surface, amounts)).quantile(_HIGHEST))
        yield_stress = self.element.constants.yield_stress
        if stress > yield_stress:
            alloy = self.specimen.recipe.implant.material
            warnings.warn(
                f"the implant is stressed to {stress:.0f} N/mm^2: {alloy} yields at {yield_stress:.0f}", stacklevel=4
            )


def pose_of(recipe: LoadRecipe) -> Tensor:
    """Rigid pose (4, 4) of the whole specimen."""
    turn = torch.deg2rad(torch.tensor(recipe.rotation, dtype=torch.float64, device="cpu"))
    return rigid_matrix(turn, torch.tensor(recipe.translation, dtype=torch.float64, device="cpu"))


def loaded(specimen: Specimen, recipe: LoadRecipe, construct: ElasticConstruct | None = None) -> Loaded:
    """Motion of a specimen's parts under a load.

    Args:
        specimen: Specimen without load.
        recipe: The load.
        construct: Elastic model of the specimen if it exists already: building it takes seconds.

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
        center_mm=recipe.center,
        length_mm=float(np.ptp(specimen.implant.vertices[:, 2])),
        rotation_deg=recipe.rotation,
        translation_mm=recipe.translation,
    )
    return _of_motion(specimen, load.motion())


def _of_motion(specimen: Specimen, motion: Callable[[Tensor], Tensor]) -> Loaded:
    """Motion of all parts when the implant's is given: screws and fragments follow the implant near the screws."""
    vertices = torch.from_numpy(np.array(specimen.implant.vertices))
    moved = motion(vertices)
    near: dict[str, list[Tensor]] = {DISTAL: [], PROXIMAL: []}
    screws = []
    for number, screw in enumerate(specimen.screws):
        motion_of, beside = _near_motion(vertices, moved, screw)
        screws.append(motion_of)
        if specimen.holds(number):
            near[specimen.fragment_of(screw.start[2])].append(beside)
    whole = fit_rigid(vertices, moved)
    fragments = {
        name: fit_rigid(vertices[torch.cat(places)], moved[torch.cat(places)]) if places else whole
        for name, places in near.items()
    }
    return Loaded(motion, fragments, screws)


def _near_motion(vertices: Tensor, moved: Tensor, screw: Screw) -> tuple[Tensor, Tensor]:
    """Rigid motion (4, 4) of the implant's vertices near a screw's head, and the indices of these vertices."""
    distances = (vertices - torch.tensor(screw.start, dtype=torch.float64, device="cpu")).norm(dim=1)
    near = (distances <= max(_NEAR_MM, float(distances.sort().values[min(8, len(distances) - 1)]))).nonzero().flatten()
    return fit_rigid(vertices[near], moved[near]), near


def _hold_nodes(element: Superelement, hold: int) -> Tensor:
    return element.holds[hold].nodes(transform_points(element.hexahedra.frame, element.hexahedra.positions))

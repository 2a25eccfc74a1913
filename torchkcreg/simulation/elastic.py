"""Elastic plate on the screws of two rigid bone fragments: its motion and the load it carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import FiniteElementDeformation
from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud, find_holes
from torchkcreg.mechanics import CarriedLoad, Superelement, holds_of, von_mises
from torchkcreg.mechanics.holds import rigid_fields
from torchkcreg.physics import elastic_constants

from .loads import RodMotion

_PITCH_MM = 0.3
_SCREW_SHEAR = 2e3  # N/mm, median translational stiffness of a screw in its bone
_SCREW_TURN = 1e5  # N mm/rad, median rotational stiffness
_SHARES = (0.2, 0.8)  # range of the plate's highest stress, as a share of the yield stress
_HIGHEST = 0.98  # quantile taken as the highest stress


class ElasticMotion:
    """Motion of points from the straight plate's frame to the loaded plate, computed in float64.

    Args:
        rest: Motion from the straight plate to the undeformed (contoured) one.
        deformation: Deformation of the undeformed plate.
        pose: Rigid motion (4, 4) applied after the deformation.
    """

    def __init__(self, rest: RodMotion, deformation: FiniteElementDeformation, pose: Tensor) -> None:
        self.rest, self.deformation, self.pose = rest, deformation, pose

    @torch.no_grad()
    def __call__(self, points: Tensor) -> Tensor:
        """Moved points in mm, with the shape and dtype of `points` (..., 3)."""
        rested = self.rest(points.double())
        moved = rested + self.deformation.displacement(rested)
        return transform_points(self.pose, moved.reshape(-1, 3)).reshape(points.shape).to(points)

    def frames(self, z: Tensor) -> Tensor:
        """Frames (n, 4, 4) fitted to the plate's motion near heights z (n,): each maps (x, y, 0) of a section."""
        around = torch.cartesian_prod(*(torch.linspace(-x, x, n).double() for x, n in zip((4.0, 1.2, 3.0), (5, 3, 5))))
        lifted = around + z.double()[:, None, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return torch.stack([fit_rigid(around, moved) for moved in self(lifted)])


@dataclass(frozen=True)
class Fragments:
    """Two rigid bone fragments and the screws that hold a plate on them.

    Attributes:
        heights: Heights of the holding screws on the straight plate, mm. Screws below 0 are in the lower fragment.
        turn_deg: Rotation vector of the upper fragment relative to the lower one, about the origin.
        shift: Translation of the upper fragment after the rotation, mm.
    """

    heights: Sequence[float]
    turn_deg: tuple[float, float, float]
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


def elastic_motion(
    rest: RodMotion, plate: trimesh.Trimesh, material: str, fragments: Fragments, pose: Tensor, rng: np.random.Generator
) -> tuple[ElasticMotion, CarriedLoad]:
    """Motion of a plate on its screws, and the load it carries.

    Screws are held in the bone by springs of random stiffness. The load is scaled so that the plate's highest stress is
    a random share of the yield stress.

    Args:
        rest: Motion from the straight plate to the undeformed (contoured) one.
        plate: Mesh of the undeformed plate.
        material: Name of the plate's material.
        fragments: Motion of the bone fragments, which bends the plate.
        pose: Additional rigid motion (4, 4) of the whole plate.
        rng: Random number generator.
    """
    cloud = ImplantPointCloud.from_mesh(plate, _PITCH_MM)
    holds = holds_of(cloud, find_holes(plate))
    element = Superelement.of(cloud, elastic_constants(material), holds, negligible_mm=0.0)
    amounts = _amounts(fragments, rest, element, rng)
    stress = von_mises(element.stress(torch.from_numpy(np.array(plate.vertices)), amounts))
    share = rng.uniform(*_SHARES) * element.constants.yield_stress
    amounts = amounts * share / float(stress.quantile(_HIGHEST))
    deformation = FiniteElementDeformation(element, amounts)
    nodes = cloud.coarsened(6).points.double()
    with torch.no_grad():
        common = fit_rigid(nodes, deformation(nodes))
    motion = ElasticMotion(rest, deformation, pose @ torch.linalg.inv(common))
    return motion, CarriedLoad.of(element, amounts)


def _amounts(fragments: Fragments, rest: RodMotion, element: Superelement, rng: np.random.Generator) -> Tensor:
    """Amounts (A,) for which used holds follow their fragments by springs, and the other holds carry no load."""
    centers = torch.tensor([hold.center for hold in element.holds], dtype=torch.float64)
    middles = rest(torch.tensor([[0.0, 0.0, z] for z in fragments.heights], dtype=torch.float64))
    used = torch.cdist(middles, centers).argmin(1).tolist()
    above = torch.tensor([z > 0 for z in fragments.heights], dtype=torch.float64)
    turn = torch.deg2rad(torch.tensor(fragments.turn_deg, dtype=torch.float64)).expand(len(used), 3)
    shift = torch.tensor(fragments.shift, dtype=torch.float64)
    prescribed = torch.cat([torch.linalg.cross(turn, centers[used]) + shift, turn], dim=1) * above[:, None]
    springs = rng.lognormal(0.0, 0.5, size=(len(used), 1)) * np.array([_SCREW_SHEAR] * 3 + [_SCREW_TURN] * 3)
    moved = hold_motions(element, used)  # (A, U, 6)
    loads = element.loads
    rigid = torch.stack([rigid_at(centers[hold]) for hold in used])  # (U, 6, 6)
    free = [hold for hold in range(len(centers)) if hold not in used]
    number = len(loads)
    yielding = moved + loads[:, used] / torch.from_numpy(springs)
    rows = [
        torch.cat([yielding.flatten(1).T, rigid.flatten(0, 1)], dim=1),
        torch.cat([loads[:, free].flatten(1).T, loads.new_zeros(6 * len(free), 6)], dim=1) * 1e-4,  # no load there
    ]
    right_hand_side = torch.cat([prescribed.flatten(), loads.new_zeros(6 * len(free))])
    return torch.linalg.lstsq(torch.cat(rows), right_hand_side[:, None], driver="gelsd").solution[:number, 0]


def hold_motions(element: Superelement, holds: list[int]) -> Tensor:
    """Translation and small rotation (A, U, 6) of holds for a unit amount."""
    positions = transform_points(element.hexahedra.frame, element.hexahedra.positions)
    motions = []
    for hold in holds:
        near = element.holds[hold].nodes(positions)
        arms = positions[near] - positions.new_tensor(element.holds[hold].center)
        fields = rigid_fields(arms)
        solution = torch.linalg.lstsq(fields.flatten(1).T, element.nodal[:, near].flatten(1).T.to(fields)).solution
        motions.append(solution.T)
    return torch.stack(motions, dim=1)


def rigid_at(center: Tensor) -> Tensor:
    """Translation and rotation (6, 6) at a point, for each of the six rigid motions about the origin."""
    identity = torch.eye(3, dtype=center.dtype)
    turning = torch.linalg.cross(identity, center.expand(3, 3)).T
    return torch.cat([torch.cat([identity, turning], dim=1), torch.cat([torch.zeros_like(identity), identity], dim=1)])

"""Implant as a free elastic body: displacements and stresses under loads in equilibrium."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array
from torch import Tensor

from torchkcreg.geometry import invert_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants

from .bodies import body_volumes, separate_bodies
from .hexahedra import Hexahedra, edge_for, interpolated
from .holds import rigid_fields
from .stiffness import stiffness_matrix
from .stress import StressField, volumes_in_cubes

_INERTIA_PITCH_MM = 1.0  # inertia only balances the loads' resultant; a coarse distribution suffices


class ElasticBody:
    """A free elastic body, its stiffness assembled and factorised once.

    Loads need not be in equilibrium: their resultant is balanced by inertia forces of the body (inertia relief), which
    vanish for loads in equilibrium. Displacements exclude rigid motion of the body and are small, linear in the loads.

    Args:
        cloud: The implant, in its frame, with a node spacing of at most a tenth of its thickness.
        constants: Elastic constants of its alloy.
        edge: Edge of the hexahedra, mm; `edge_for(cloud)` if None.

    Raises:
        ValueError: If the implant is several bodies that do not touch, or too loose for its elements.

    Attributes:
        hexahedra: The elements (cubes); displacements are given at their nodes, (..., N, 3), in the implant's axes, mm.
        filled: Metal volume in each cube, shape (E,), mm^3.
        stiffness: Sparse matrix (3 N, 3 N), N/mm, in the lattice's axes.
    """

    def __init__(self, cloud: ImplantPointCloud, constants: ElasticConstants, *, edge: float | None = None) -> None:
        if len(volumes := body_volumes(cloud)) > 1:
            parts = " and ".join(f"{volume:.0f} mm^3" for volume in volumes[:3])
            raise ValueError(f"{separate_bodies(len(volumes))} They have {parts}.")
        self.cloud, self.constants = cloud, constants
        self.hexahedra = Hexahedra.around(cloud, edge_for(cloud) if edge is None else edge)
        self.stiffness = stiffness_matrix(self.hexahedra, cloud, constants)
        self._turn = self.hexahedra.frame[:3, :3]
        self.filled = volumes_in_cubes(self.hexahedra, cloud)
        positions = self.hexahedra.positions
        middle = positions.mean(0)
        self._rigid = rigid_fields(positions - middle)  # (6, N, 3)
        coarse = cloud.coarsened_to(_INERTIA_PITCH_MM)
        local = transform_points(invert_rigid(self.hexahedra.frame), coarse.points.double()) - middle
        self._inertia = self.nodal_loads(coarse.points, rigid_fields(local) * coarse.volumes.double()[:, None])
        self._gram = torch.einsum("kni,lni->kl", self._inertia, self._rigid)
        self._pinned = _pinned(positions)
        try:
            self._factor = cholesky_banded(_banded(self.stiffness, self._pinned), lower=True, overwrite_ab=True)
        except LinAlgError:
            raise ValueError(
                "the implant's stiffness matrix is singular, because some of its parts are hardly connected: bend it "
                "with --deformation modes"
            ) from None

    def nodal_loads(self, points: Tensor, forces: Tensor) -> Tensor:
        """Nodal loads (..., N, 3) equivalent to forces (..., P, 3) at points (P, 3); all in the lattice's axes.

        Args:
            points: Points in the implant's frame, mm.
            forces: Forces in N.
        """
        cube, inside = self.hexahedra.locate(points)
        values, _ = self.hexahedra.shape_functions(inside)
        nodes = self.hexahedra.nodes[cube].flatten()
        spread = (values[..., None] * forces[..., :, None, :]).flatten(-3, -2)
        loads = spread.new_zeros(*forces.shape[:-2], self.hexahedra.num_nodes, 3)
        return loads.index_add_(-2, nodes, spread)

    def response(self, points: Sequence[Tensor], forces: Sequence[Tensor]) -> Tensor:
        """Displacements (L, N, 3) of the hexahedra's nodes under each of L loads, in the implant's axes.

        Args:
            points: For each load, its points of application (P, 3) in the implant's frame.
            forces: For each load, its forces (P, 3) there, in the implant's axes, N.
        """
        pairs = zip(points, forces, strict=True)
        loads = torch.stack([self.nodal_loads(places, force.double() @ self._turn) for places, force in pairs])
        surplus = torch.einsum("lni,kni->lk", loads, self._rigid)
        loads = loads - torch.einsum("lk,kni->lni", torch.linalg.solve(self._gram.mT, surplus.mT).mT, self._inertia)
        right_side = loads.flatten(1).cpu().numpy().T.copy()
        right_side[self._pinned] = 0.0
        solved = torch.from_numpy(cho_solve_banded((self._factor, True), right_side).T).to(loads)
        moved = solved.unflatten(-1, (-1, 3))
        along = torch.einsum("lni,kni->lk", moved, self._inertia)
        moved = moved - torch.einsum("lk,kni->lni", torch.linalg.solve(self._gram, along.mT).mT, self._rigid)
        return moved @ self._turn.mT

    def displacement(self, points: Tensor, nodal: Tensor) -> Tensor:
        """Displacements (L, P, 3) at points (P, 3) in the implant's frame, from those (L, N, 3) at the nodes, mm."""
        return interpolated(self.hexahedra, nodal, *self.hexahedra.locate(points))

    def stress(self, points: Tensor, nodal: Tensor) -> Tensor:
        """Stresses (L, P, 3, 3) at points (P, 3) of the implant, N/mm^2, in its axes; see `StressField`."""
        return StressField.of(self.hexahedra, self.filled, self.constants, nodal).at(points)


def _pinned(positions: Tensor) -> list[int]:
    """Indices of six degrees of freedom, at three nodes far apart, that fix a body without straining it."""
    spread = positions.amax(0) - positions.amin(0)
    first = int((positions - positions.amin(0)).norm(dim=-1).argmin())
    away = positions - positions[first]
    long = int(spread.argmax())
    second = int(away[:, long].abs().argmax())
    across = torch.linalg.cross(away, away[second].expand_as(away)).norm(dim=-1)
    third = int(across.argmax())
    normal = torch.linalg.cross(away[second], away[third])
    others = [axis for axis in range(3) if axis != long]
    turning = 3 * third + int(normal.abs().argmax())
    return [*(3 * first + axis for axis in range(3)), *(3 * second + axis for axis in others), turning]


def _banded(matrix: csr_array, pinned: Sequence[int]) -> np.ndarray:
    """Lower triangle of a symmetric matrix in banded storage (bandwidth, n), with pinned displacements eliminated."""
    entries = matrix.tocoo()
    rows, columns = entries.coords
    lower = rows >= columns
    rows, columns, values = rows[lower], columns[lower], entries.data[lower].copy()
    values[np.isin(rows, pinned) | np.isin(columns, pinned)] = 0.0
    band = np.zeros((int((rows - columns).max()) + 1, matrix.shape[0]))
    band[rows - columns, columns] = values
    band[0, list(pinned)] = float(matrix.diagonal().mean())
    return band

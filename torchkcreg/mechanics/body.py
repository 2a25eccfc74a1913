"""An implant as an elastic body: how it bends under loads that are in balance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array
from torch import Tensor

from torchkcreg.geometry import invert_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics.hexahedra import Hexahedra, edge_for
from torchkcreg.mechanics.stiffness import stiffness_matrix
from torchkcreg.physics import ElasticConstants

_INERTIA_PITCH_MM = 1.0  # what is left over of loads is carried evenly; any even distribution will do


class ElasticBody:
    """A free elastic body, its stiffness assembled and factorised once.

    Loads need not be in balance: what is left over is carried by the body's inertia (as if it were accelerated, which
    loads that do balance each other cancel). Displacements are those without the body's motion as a whole. They are
    small: linear in the loads.

    Args:
        cloud: The implant, in its frame; on nodes of a tenth of its thickness or less.
        constants: Of its alloy.
        edge: Of the cubes that carry the displacements, mm; see `edge_for` if None.

    Attributes:
        hexahedra: The cubes; displacements are given at their nodes, (..., N, 3), in the implant's axes, mm.
        stiffness: Sparse matrix (3 N, 3 N), N/mm, in the lattice's axes.
    """

    def __init__(self, cloud: ImplantPointCloud, constants: ElasticConstants, *, edge: float | None = None) -> None:
        self.cloud, self.constants = cloud, constants
        self.hexahedra = Hexahedra.around(cloud, edge_for(cloud) if edge is None else edge)
        self.stiffness = stiffness_matrix(self.hexahedra, cloud, constants)
        self._turn = self.hexahedra.frame[:3, :3]
        cube, _ = self.hexahedra.locate(cloud.points)
        volumes = cloud.volumes.double()
        self._filled = volumes.new_zeros(len(self.hexahedra.cells)).index_add_(0, cube, volumes)
        positions = self.hexahedra.positions
        middle = positions.mean(0)
        self._rigid = _rigid_fields(positions - middle)  # (6, N, 3)
        coarse = cloud.coarsened_to(_INERTIA_PITCH_MM)
        local = transform_points(invert_rigid(self.hexahedra.frame), coarse.points.double()) - middle
        self._inertia = self.nodal_loads(coarse.points, _rigid_fields(local) * coarse.volumes.double()[:, None])
        self._gram = torch.einsum("kni,lni->kl", self._inertia, self._rigid)
        self._pinned = _pinned(positions)
        self._factor = cholesky_banded(_banded(self.stiffness, self._pinned), lower=True, overwrite_ab=True)

    def nodal_loads(self, points: Tensor, forces: Tensor) -> Tensor:
        """Forces (..., P, 3) at points (P, 3) as loads (..., N, 3) at the hexahedra's nodes; all in the lattice's axes.

        Args:
            points: In the implant's frame.
            forces: N.
        """
        cube, inside = self.hexahedra.locate(points)
        values, _ = self.hexahedra.shape_functions(inside)
        nodes = self.hexahedra.nodes[cube].flatten()
        spread = (values[..., None] * forces[..., :, None, :]).flatten(-3, -2)
        loads = spread.new_zeros(*forces.shape[:-2], self.hexahedra.num_nodes, 3)
        return loads.index_add_(-2, nodes, spread)

    def response(self, points: Sequence[Tensor], forces: Sequence[Tensor]) -> Tensor:
        """Displacements (L, N, 3) of the hexahedra's nodes under L loads, each of its own, in the implant's axes.

        Args:
            points: Where each load acts, (P, 3) in the implant's frame.
            forces: Its forces there, (P, 3) in the implant's axes, N.
        """
        pairs = zip(points, forces, strict=True)
        loads = torch.stack([self.nodal_loads(where, force.double() @ self._turn) for where, force in pairs])
        surplus = torch.einsum("lni,kni->lk", loads, self._rigid)
        loads = loads - torch.einsum("lk,kni->lni", torch.linalg.solve(self._gram.mT, surplus.mT).mT, self._inertia)
        right = loads.flatten(1).cpu().numpy().T.copy()
        right[self._pinned] = 0.0
        solved = torch.from_numpy(cho_solve_banded((self._factor, True), right).T).to(loads)
        moved = solved.unflatten(-1, (-1, 3))
        along = torch.einsum("lni,kni->lk", moved, self._inertia)
        moved = moved - torch.einsum("lk,kni->lni", torch.linalg.solve(self._gram, along.mT).mT, self._rigid)
        return moved @ self._turn.mT

    def displacement(self, points: Tensor, nodal: Tensor) -> Tensor:
        """Displacements (L, P, 3) of points (P, 3) of the implant's frame, of those (L, N, 3) of the nodes, mm."""
        cube, inside = self.hexahedra.locate(points)
        values, _ = self.hexahedra.shape_functions(inside)
        return torch.einsum("pa,lpai->lpi", values, nodal[:, self.hexahedra.nodes[cube]])

    def stress(self, points: Tensor, nodal: Tensor) -> Tensor:
        """Stresses (L, P, 3, 3) at points of the implant, N/mm^2, in its axes.

        Taken where quadratic shape functions know them best, at the 2 x 2 x 2 places of Barlow (1976) in each cube,
        extrapolated to the cubes' corners, averaged there over the metal, and linear in between.
        """
        cells = self.hexahedra
        lowest = [0, 2, 6, 8, 18, 20, 24, 26]
        ends = torch.tensor([-1.0, 1.0], dtype=torch.float64, device=nodal.device)
        corners = torch.cartesian_prod(ends, ends, ends)
        _, slopes = cells.shape_functions(corners / math.sqrt(3))
        taken = self._stresses(torch.einsum("gaj,leai->legij", slopes, nodal[:, cells.nodes]))
        outward = torch.einsum("cg,legij->lecij", _trilinear(corners * math.sqrt(3)), taken)
        nodes = cells.nodes[:, lowest]
        share = self._filled[:, None].expand(nodes.shape)
        sums = outward.new_zeros(len(nodal), cells.num_nodes, 3, 3)
        sums.index_add_(1, nodes.flatten(), (outward * share[..., None, None]).flatten(1, 2))
        whole = share.new_zeros(cells.num_nodes).index_add_(0, nodes.flatten(), share.flatten())
        cube, inside = cells.locate(points)
        there = sums[:, nodes[cube]] / whole[nodes[cube]][..., None, None]
        return torch.einsum("pc,lpcij->lpij", _trilinear(inside.clamp(-1, 1)), there)

    def _stresses(self, slopes: Tensor) -> Tensor:
        """Of displacement gradients (..., 3, 3), d u_i / d x_j: i along the implant's axes, j along the lattice's."""
        slopes = slopes @ self._turn.mT
        strain = 0.5 * (slopes + slopes.mT)
        lame, shear = self.constants.lame
        trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
        same = torch.eye(3, dtype=strain.dtype, device=strain.device)
        return lame * trace[..., None, None] * same + 2 * shear * strain


def _trilinear(inside: Tensor) -> Tensor:
    """Weights (P, 8) of a cube's corners at places (P, 3) in it, from -1 to 1."""
    ends = torch.stack([1 - inside, 1 + inside], dim=-1) / 2
    return torch.einsum("pi,pj,pk->pijk", *ends.unbind(1)).flatten(1)


def von_mises(stress: Tensor) -> Tensor:
    """Equivalent stress (...) of stresses (..., 3, 3): metal yields where it reaches the yield stress."""
    trace = stress.diagonal(dim1=-2, dim2=-1).sum(-1)
    deviator = stress - trace[..., None, None] / 3 * torch.eye(3, dtype=stress.dtype, device=stress.device)
    return (1.5 * deviator.square().sum((-2, -1))).sqrt()


def _rigid_fields(positions: Tensor) -> Tensor:
    """Three shifts and three turns (6, N, 3) of positions (N, 3)."""
    axes = torch.eye(3, dtype=positions.dtype, device=positions.device)
    shifts = axes[:, None].expand(3, len(positions), 3)
    turns = torch.linalg.cross(axes[:, None].expand_as(shifts), positions[None].expand_as(shifts))
    return torch.cat([shifts, turns])


def _pinned(positions: Tensor) -> list[int]:
    """Numbers of six displacements that hold a body in its place without straining it: of three nodes far apart."""
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
    """The lower half of a symmetric matrix by its diagonals (bandwidth, n), pinned displacements taken out."""
    entries = matrix.tocoo()
    rows, columns = entries.coords
    kept = rows >= columns
    rows, columns, values = rows[kept], columns[kept], entries.data[kept].copy()
    values[np.isin(rows, pinned) | np.isin(columns, pinned)] = 0.0
    band = np.zeros((int((rows - columns).max()) + 1, matrix.shape[0]))
    band[rows - columns, columns] = values
    band[0, list(pinned)] = float(matrix.diagonal().mean())
    return band

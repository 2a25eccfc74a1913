"""Hexahedra of 27 nodes on a lattice around an implant: where their nodes are, and what they give to points inside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from torchkcreg.geometry import invert_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud

NODES = 27
_BORDER = 1e-2  # of an edge: a cube is not begun for less


@dataclass(frozen=True, eq=False)
class Hexahedra:
    """Cubes of a lattice that hold any of an implant, each with 3 x 3 x 3 nodes of quadratic shape functions.

    Attributes:
        frame: Rigid transform (4, 4) from the lattice's frame to the implant's; its axes are the implant's principal
            ones, the longest last.
        edge: Of a cube, mm.
        cells: Lattice indices (E, 3) of the cubes.
        nodes: Numbers (E, 27) of their nodes, which follow each other along the implant.
        positions: Of the nodes (N, 3) in the lattice's frame, mm.
        number_of: Number of the cube at each place of the lattice, -1 where there is none.
    """

    frame: Tensor
    edge: float
    cells: Tensor
    nodes: Tensor
    positions: Tensor
    number_of: Tensor

    @classmethod
    def around(cls, cloud: ImplantPointCloud, edge: float) -> Hexahedra:
        """Cubes around an implant, so placed that its thickness is divided evenly."""
        center, axes, _ = (t.double() for t in cloud.principal_axes())
        frame = torch.eye(4, dtype=torch.float64, device=center.device)
        frame[:3, :3], frame[:3, 3] = axes.mT, center
        local = transform_points(invert_rigid(frame), cloud.points.double())
        low, high = local.amin(0) - cloud.pitch / 2, local.amax(0) + cloud.pitch / 2
        counts = ((high - low) / edge - _BORDER).ceil().clamp_min(1)
        origin = (low + high - counts * edge) / 2
        frame[:3, 3] = transform_points(frame, origin)
        shape = [int(n) for n in counts.tolist()]
        filled = torch.zeros(shape, dtype=torch.bool, device=center.device)
        index = ((local - origin) / edge).floor().long()
        index = torch.minimum(index.clamp_min(0), torch.tensor(shape, device=index.device) - 1)
        filled[tuple(index.unbind(-1))] = True
        cells = filled.permute(2, 1, 0).nonzero().flip(-1)  # along the longest axis first
        return cls.of_cells(frame, edge, cells)

    @classmethod
    def of_cells(cls, frame: Tensor, edge: float, cells: Tensor) -> Hexahedra:
        """Of the lattice indices of cubes, which begin at zero along each axis."""
        shape = [int(n) for n in (cells.amax(0) + 1).tolist()]
        number_of = torch.full(shape, -1, dtype=torch.long, device=cells.device)
        number_of[tuple(cells.unbind(-1))] = torch.arange(len(cells), device=cells.device)
        return cls(frame, edge, cells, *_numbered(cells, shape, edge), number_of)

    @property
    def num_nodes(self) -> int:
        """Of all cubes together."""
        return len(self.positions)

    def locate(self, points: Tensor, among: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The cube (P,) that each point (P, 3) of the implant's frame is in, and where in it (P, 3), from -1 to 1.

        Points beside the cubes belong to the nearest one, of which they are then outside.

        Args:
            points: In the implant's frame.
            among: Which cubes are meant, (E,), bool; all when None.
        """
        local = transform_points(invert_rigid(self.frame), points.double())
        shape = torch.tensor(self.number_of.shape, device=local.device)
        index = torch.minimum((local / self.edge).floor().long().clamp_min(0), shape - 1)
        cube = self.number_of[tuple(index.unbind(-1))]
        meant = torch.ones(len(self.cells), dtype=torch.bool, device=local.device) if among is None else among
        astray, candidates = ((cube < 0) | ~meant[cube]).nonzero().flatten(), meant.nonzero().flatten()
        if len(astray):
            middles = (self.cells[candidates].double() + 0.5) * self.edge
            for some in astray.split(4096):
                cube[some] = candidates[torch.cdist(local[some], middles).argmin(-1)]
        inside = 2 * (local / self.edge - self.cells[cube]) - 1
        return cube, inside

    def neighbours(self, axis: int, step: int) -> Tensor:
        """Number of the cube (E,) so many steps along an axis from each, -1 where there is none."""
        cells = self.cells.clone()
        cells[:, axis] += step
        size = self.number_of.shape[axis]
        there = (cells[:, axis] >= 0) & (cells[:, axis] < size)
        cells[:, axis].clamp_(0, size - 1)
        return torch.where(there, self.number_of[tuple(cells.unbind(-1))], -1)

    def shape_functions(self, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Values (P, 27) and gradients (P, 27, 3), 1/mm in the lattice's frame, at places (P, 3) inside cubes."""
        values, slopes = quadratics(inside), _quadratic_slopes(inside) * (2 / self.edge)
        (x, y, z), (dx, dy, dz) = values.unbind(1), slopes.unbind(1)
        together = torch.einsum("pi,pj,pk->pijk", x, y, z).flatten(1)
        gradients = [
            torch.einsum("pi,pj,pk->pijk", *parts).flatten(1) for parts in ((dx, y, z), (x, dy, z), (x, y, dz))
        ]
        return together, torch.stack(gradients, dim=-1)


def interpolated(hexahedra: Hexahedra, nodal: Tensor, cube: Tensor, inside: Tensor) -> Tensor:
    """Values (L, P, 3) at places (P, 3) in cubes (P,) of values (L, N, 3) at the nodes."""
    values, _ = hexahedra.shape_functions(inside)
    table = nodal.transpose(0, 1).flatten(1)
    found = embedding_bag(hexahedra.nodes[cube], table, per_sample_weights=values.to(table), mode="sum")
    return found.unflatten(1, (len(nodal), 3)).transpose(0, 1)


def quadratics(inside: Tensor) -> Tensor:
    """Lagrange polynomials (P, 3, 3) through -1, 0 and 1, along each axis."""
    return torch.stack([inside * (inside - 1) / 2, 1 - inside**2, inside * (inside + 1) / 2], dim=-1)


def _quadratic_slopes(inside: Tensor) -> Tensor:
    return torch.stack([inside - 0.5, -2 * inside, inside + 0.5], dim=-1)


def _numbered(cells: Tensor, shape: list[int], edge: float) -> tuple[Tensor, Tensor]:
    """Nodes (E, 27) of cubes, numbered layer by layer along the last axis, and their positions (N, 3)."""
    steps = torch.arange(3, device=cells.device)
    offsets = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(-1, 3)
    lattice = 2 * cells[:, None] + offsets  # (E, 27, 3) on the lattice of half the edge
    wide, deep, _ = (2 * n + 1 for n in shape)
    flat = (lattice[..., 2] * deep + lattice[..., 1]) * wide + lattice[..., 0]
    distinct, nodes = torch.unique(flat, return_inverse=True)
    columns = torch.stack([distinct % wide, distinct // wide % deep, distinct // (wide * deep)], dim=-1)
    return nodes, columns.double() * (edge / 2)


def edge_for(cloud: ImplantPointCloud, *, most_nodes: int = 20_000) -> float:
    """Edge of cubes, mm: half the implant's thickness, as far as that leaves no more than so many nodes.

    Quadratic shape functions follow a bend across a cube exactly; two across the thickness follow how holes disturb it.
    """
    _, _, extents = cloud.principal_axes()
    thickness = float(extents.min()) + cloud.pitch
    volume = float(np.prod([float(e) + cloud.pitch for e in extents]))
    finest = (8 * volume / most_nodes) ** (1 / 3)
    return max(thickness / max(1, math.floor(thickness / max(finest, thickness / 2))), finest)

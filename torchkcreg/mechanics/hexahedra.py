"""Lattice of hexahedral elements with 27 nodes around an implant: nodes, shape functions, interpolation."""

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
_BORDER = 1e-2  # of an edge: a smaller remainder gets no further cube


@dataclass(frozen=True, eq=False)
class Hexahedra:
    """Lattice cubes that contain part of an implant, each with 3 x 3 x 3 nodes and quadratic shape functions.

    Attributes:
        frame: Rigid transform (4, 4) from the lattice's frame to the implant's; its axes are the implant's principal
            axes, the longest one last.
        edge: Edge of a cube, mm.
        cells: Lattice indices (E, 3) of the cubes.
        nodes: Node indices (E, 27) of the cubes, numbered along the implant.
        positions: Positions (N, 3) of the nodes in the lattice's frame, mm.
        number_of: Index of the cube at each lattice position, -1 if there is none.
    """

    frame: Tensor
    edge: float
    cells: Tensor
    nodes: Tensor
    positions: Tensor
    number_of: Tensor

    @classmethod
    def around(cls, cloud: ImplantPointCloud, edge: float) -> Hexahedra:
        """Cubes around an implant, centred on its extent along each axis."""
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
        """Hexahedra from the lattice indices of the cubes, which start at zero along each axis."""
        shape = [int(n) for n in (cells.amax(0) + 1).tolist()]
        number_of = torch.full(shape, -1, dtype=torch.long, device=cells.device)
        number_of[tuple(cells.unbind(-1))] = torch.arange(len(cells), device=cells.device)
        return cls(frame, edge, cells, *_numbered(cells, shape, edge), number_of)

    @property
    def num_nodes(self) -> int:
        """Number of nodes of all cubes together."""
        return len(self.positions)

    def locate(self, points: Tensor, among: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Index (P,) of the cube that contains each point (P, 3), and local coordinates (P, 3) in it, from -1 to 1.

        A point outside all cubes gets the nearest cube; its local coordinates then lie outside -1 to 1.

        Args:
            points: Points in the implant's frame.
            among: Mask (E,) of the cubes to choose from; all if None.
        """
        local = transform_points(invert_rigid(self.frame), points.double())
        shape = torch.tensor(self.number_of.shape, device=local.device)
        index = torch.minimum((local / self.edge).floor().long().clamp_min(0), shape - 1)
        cube = self.number_of[tuple(index.unbind(-1))]
        allowed = torch.ones(len(self.cells), dtype=torch.bool, device=local.device) if among is None else among
        outside, candidates = ((cube < 0) | ~allowed[cube]).nonzero().flatten(), allowed.nonzero().flatten()
        if len(outside):
            middles = (self.cells[candidates].double() + 0.5) * self.edge
            for chunk in outside.split(4096):
                cube[chunk] = candidates[torch.cdist(local[chunk], middles).argmin(-1)]
        inside = 2 * (local / self.edge - self.cells[cube]) - 1
        return cube, inside

    def neighbours(self, axis: int, step: int) -> Tensor:
        """Index (E,) of the neighbour of each cube, `step` cubes along an axis; -1 if there is none."""
        cells = self.cells.clone()
        cells[:, axis] += step
        size = self.number_of.shape[axis]
        in_lattice = (cells[:, axis] >= 0) & (cells[:, axis] < size)
        cells[:, axis].clamp_(0, size - 1)
        return torch.where(in_lattice, self.number_of[tuple(cells.unbind(-1))], -1)

    def shape_functions(self, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Values (P, 27) and gradients (P, 27, 3), 1/mm in the lattice's frame, at local coordinates (P, 3)."""
        values, slopes = quadratics(inside), _quadratic_slopes(inside) * (2 / self.edge)
        (x, y, z), (dx, dy, dz) = values.unbind(1), slopes.unbind(1)
        products = torch.einsum("pi,pj,pk->pijk", x, y, z).flatten(1)
        gradients = [
            torch.einsum("pi,pj,pk->pijk", *parts).flatten(1) for parts in ((dx, y, z), (x, dy, z), (x, y, dz))
        ]
        return products, torch.stack(gradients, dim=-1)


def interpolated(hexahedra: Hexahedra, nodal: Tensor, cube: Tensor, inside: Tensor) -> Tensor:
    """Values (L, P, 3) at local coordinates (P, 3) in cubes (P,), interpolated from nodal values (L, N, 3)."""
    values, _ = hexahedra.shape_functions(inside)
    table = nodal.transpose(0, 1).flatten(1)
    values_at_points = embedding_bag(hexahedra.nodes[cube], table, per_sample_weights=values.to(table), mode="sum")
    return values_at_points.unflatten(1, (len(nodal), 3)).transpose(0, 1)


def quadratics(inside: Tensor) -> Tensor:
    """Quadratic Lagrange polynomials (P, 3, 3) with nodes -1, 0 and 1, along each axis."""
    return torch.stack([inside * (inside - 1) / 2, 1 - inside**2, inside * (inside + 1) / 2], dim=-1)


def _quadratic_slopes(inside: Tensor) -> Tensor:
    return torch.stack([inside - 0.5, -2 * inside, inside + 0.5], dim=-1)


def _numbered(cells: Tensor, shape: list[int], edge: float) -> tuple[Tensor, Tensor]:
    """Node indices (E, 27) of cubes, numbered layer by layer along the last axis, and node positions (N, 3)."""
    steps = torch.arange(3, device=cells.device)
    offsets = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(-1, 3)
    lattice = 2 * cells[:, None] + offsets  # (E, 27, 3) on a lattice with half the edge
    wide, deep, _ = (2 * n + 1 for n in shape)
    flat = (lattice[..., 2] * deep + lattice[..., 1]) * wide + lattice[..., 0]
    distinct, nodes = torch.unique(flat, return_inverse=True)
    columns = torch.stack([distinct % wide, distinct // wide % deep, distinct // (wide * deep)], dim=-1)
    return nodes, columns.double() * (edge / 2)


def edge_for(cloud: ImplantPointCloud, *, most_nodes: int = 20_000) -> float:
    """Edge of the cubes, mm: half the implant's thickness, or more if that would give more than `most_nodes` nodes.

    Quadratic shape functions represent bending across a cube exactly; two cubes across the thickness also represent the
    disturbance by holes.
    """
    _, _, extents = cloud.principal_axes()
    thickness = float(extents.min()) + cloud.pitch
    volume = float(np.prod([float(e) + cloud.pitch for e in extents]))
    finest = (8 * volume / most_nodes) ** (1 / 3)
    return max(thickness / max(1, math.floor(thickness / max(finest, thickness / 2))), finest)

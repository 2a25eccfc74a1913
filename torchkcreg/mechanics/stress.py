"""Stresses of an elastic body out of the displacements of its hexahedra's nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants

from .hexahedra import Hexahedra, quadratics

_NODES = (0, 2, 6, 8, 9, 11, 15, 17, 18, 20, 24, 26)  # of a cube's 27: three through the thickness, two across it
_FULL_ENOUGH = 0.5  # of a cube that is full: what is in it then holds all of its shape functions
_BEYOND = 2.0  # half edges from a cube's middle, as far as its stresses go on


def volumes_in_cubes(hexahedra: Hexahedra, cloud: ImplantPointCloud) -> Tensor:
    """How much of an implant is in each cube, shape (E,), mm^3."""
    cube, _ = hexahedra.locate(cloud.points)
    volumes = cloud.volumes.double()
    return volumes.new_zeros(len(hexahedra.cells)).index_add_(0, cube, volumes)


@dataclass(frozen=True, eq=False)
class StressField:
    """Stresses everywhere in an implant, for L displacements of its hexahedra's nodes.

    Taken where quadratic shape functions know them best, at the 2 x 2 x 2 places of Barlow (1976) in each cube. Through
    the thickness, along the lattice's first axis, a parabola is fitted to those of a cube and its neighbours there (the
    shear of a twisted plate is one), across it straight lines. The cubes' values at their nodes are averaged over the
    metal. Cubes that hold little metal leave some of their shape functions free and do not take part: what is in them
    has the stress of the nearest cube that does, continued.

    Attributes:
        hexahedra: Around the implant.
        trusted: Cubes that take part, (E,), bool.
        nodal: Stresses at the hexahedra's nodes, (L, N, 3, 3), in the implant's axes, N/mm^2; at those on the edges of
            cubes that run through the thickness.
    """

    hexahedra: Hexahedra
    trusted: Tensor
    nodal: Tensor

    @classmethod
    def of(cls, hexahedra: Hexahedra, filled: Tensor, constants: ElasticConstants, nodal: Tensor) -> StressField:
        """Of displacements.

        Args:
            hexahedra: Around the implant.
            filled: How much of it is in each cube, shape (E,).
            constants: Of its alloy.
            nodal: Displacements of the hexahedra's nodes, shape (L, N, 3), in the implant's axes, mm.
        """
        ends = filled.new_tensor([-1.0, 1.0])
        _, slopes = hexahedra.shape_functions(torch.cartesian_prod(ends, ends, ends) / math.sqrt(3))
        gradients = torch.einsum("gaj,leai->legij", slopes, nodal.double()[:, hexahedra.nodes])
        known = _stresses(gradients @ hexahedra.frame[:3, :3].mT, constants).unflatten(2, (2, 2, 2))
        trusted = filled >= _FULL_ENOUGH * filled.max()
        outward = torch.einsum(
            "ja,kb,leiabst->leijkst", _lines(ends), _lines(ends), _through(hexahedra, trusted, known)
        )
        nodes, share = hexahedra.nodes[:, list(_NODES)], (filled * trusted)[:, None].expand(-1, len(_NODES))
        sums = outward.new_zeros(len(nodal), hexahedra.num_nodes, 3, 3)
        sums.index_add_(1, nodes.flatten(), (outward.flatten(2, 4) * share[..., None, None]).flatten(1, 2))
        whole = share.new_zeros(hexahedra.num_nodes).index_add_(0, nodes.flatten(), share.flatten())
        return cls(hexahedra, trusted, sums / whole.clamp_min(torch.finfo(whole.dtype).tiny)[:, None, None])

    def at(self, points: Tensor) -> Tensor:
        """Stresses (L, P, 3, 3) at points (P, 3) of the implant's frame, N/mm^2, in its axes."""
        cube, inside = self.hexahedra.locate(points, self.trusted)
        inside = inside.clamp(-_BEYOND, _BEYOND)
        straight = [torch.stack([1 - x, 1 + x], dim=-1) / 2 for x in inside[:, 1:].unbind(-1)]
        shares = torch.einsum("pi,pj,pk->pijk", quadratics(inside)[:, 0], *straight).flatten(1)
        return torch.einsum("pc,lpcij->lpij", shares, self.nodal[:, self.hexahedra.nodes[:, list(_NODES)][cube]])


def von_mises(stress: Tensor) -> Tensor:
    """Equivalent stress (...) of stresses (..., 3, 3): metal yields where it reaches the yield stress."""
    return (1.5 * deviator(stress).square().sum((-2, -1))).sqrt()


def deviator(stress: Tensor) -> Tensor:
    """Stresses (..., 3, 3) without their mean pressure."""
    pressure = stress.diagonal(dim1=-2, dim2=-1).mean(-1)
    return stress - pressure[..., None, None] * torch.eye(3, dtype=stress.dtype, device=stress.device)


def _lines(ends: Tensor) -> Tensor:
    """Values at both ends (2,) of a cube's edge of the straight line through two places of Barlow, (2, 2)."""
    return 0.5 * (1 + math.sqrt(3) * torch.outer(ends, ends))


def _through(hexahedra: Hexahedra, trusted: Tensor, known: Tensor) -> Tensor:
    """Values (L, E, 3, 2, 2, ...) at both ends and the middle of cubes' edges through the thickness.

    Args:
        hexahedra: E cubes.
        trusted: Whose values count.
        known: Values (L, E, 2, 2, 2, ...) at the places of Barlow.
    """
    neighbours = torch.stack([hexahedra.neighbours(0, step) for step in (-1, 0, 1)], dim=1)  # (E, 3)
    counts = (neighbours >= 0) & trusted[neighbours]
    counts[:, 1] = True
    steps = torch.tensor([-2.0, 0.0, 2.0], dtype=known.dtype, device=known.device)
    places = (steps[:, None] + steps[[0, 2]] / (2 * math.sqrt(3))).flatten()  # (6,), in half edges
    terms = torch.stack([torch.ones_like(places), places, places**2], dim=-1)
    wanted = torch.stack([torch.ones_like(steps), steps / 2, (steps / 2) ** 2], dim=-1)
    found = torch.zeros_like(known[:, :, :1]).repeat_interleave(3, 2)
    for case in torch.unique(counts, dim=0):
        these = (counts == case).all(1).nonzero().flatten()
        used = case.repeat_interleave(2)
        order = min(3, int(used.sum()))  # two places alone: a straight line
        weights = wanted[:, :order] @ torch.linalg.pinv(terms[:, :order] * used[:, None])
        values = known[:, neighbours[these]].flatten(2, 3)
        found[:, these] = torch.einsum("tg,leg...->let...", weights * used, values)
    return found


def _stresses(slopes: Tensor, constants: ElasticConstants) -> Tensor:
    """Of displacement gradients (..., 3, 3), d u_i / d x_j (Hooke's law)."""
    strain = 0.5 * (slopes + slopes.mT)
    lame, shear = constants.lame
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    same = torch.eye(3, dtype=strain.dtype, device=strain.device)
    return lame * trace[..., None, None] * same + 2 * shear * strain

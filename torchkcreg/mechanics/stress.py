"""Stresses of an elastic body from the displacements of its hexahedra's nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants

from .hexahedra import Hexahedra, quadratics

# of a cube's 27 nodes: three through the thickness, two along each of the other axes
_NODES = (0, 2, 6, 8, 9, 11, 15, 17, 18, 20, 24, 26)
_FULL_ENOUGH = 0.5  # of a full cube: its metal then constrains all of its shape functions
_BEYOND = 2.0  # in half edges from a cube's centre: limit of extrapolation of its stresses


def volumes_in_cubes(hexahedra: Hexahedra, cloud: ImplantPointCloud) -> Tensor:
    """Metal volume in each cube, shape (E,), mm^3."""
    cube, _ = hexahedra.locate(cloud.points)
    volumes = cloud.volumes.double()
    return volumes.new_zeros(len(hexahedra.cells)).index_add_(0, cube, volumes)


@dataclass(frozen=True, eq=False)
class StressField:
    """Stresses everywhere in an implant, for L displacement fields of its hexahedra's nodes.

    Stresses are sampled where quadratic elements are most accurate, at the 2 x 2 x 2 Barlow points (Barlow 1976) of
    each cube. Through the thickness (the lattice's first axis) a parabola is fitted to the samples of a cube and its
    two neighbours, because the shear of a twisted plate is parabolic; along the other axes straight lines are used. The
    cubes' values at shared nodes are averaged, weighted by metal volume. Cubes with little metal leave some of their
    shape functions unconstrained and are not used: the metal in them gets the extrapolated stress of the nearest
    trusted cube.

    Attributes:
        hexahedra: Hexahedra around the implant.
        trusted: Mask (E,) of the cubes that are used.
        nodal: Stresses at the hexahedra's nodes, (L, N, 3, 3), in the implant's axes, N/mm^2. Only set for nodes on the
            cube edges that run through the thickness.
    """

    hexahedra: Hexahedra
    trusted: Tensor
    nodal: Tensor

    @classmethod
    def of(cls, hexahedra: Hexahedra, filled: Tensor, constants: ElasticConstants, nodal: Tensor) -> StressField:
        """Stress field of displacements.

        Args:
            hexahedra: Hexahedra around the implant.
            filled: Metal volume in each cube, shape (E,), mm^3.
            constants: Elastic constants of its alloy.
            nodal: Displacements of the hexahedra's nodes, shape (L, N, 3), in the implant's axes, mm.
        """
        ends = filled.new_tensor([-1.0, 1.0])
        _, slopes = hexahedra.shape_functions(torch.cartesian_prod(ends, ends, ends) / math.sqrt(3))
        gradients = torch.einsum("gaj,leai->legij", slopes, nodal.double()[:, hexahedra.nodes])
        samples = _stresses(gradients @ hexahedra.frame[:3, :3].mT, constants).unflatten(2, (2, 2, 2))
        trusted = filled >= _FULL_ENOUGH * filled.max()
        outward = torch.einsum(
            "ja,kb,leiabst->leijkst", _lines(ends), _lines(ends), _through(hexahedra, trusted, samples)
        )
        nodes, share = hexahedra.nodes[:, list(_NODES)], (filled * trusted)[:, None].expand(-1, len(_NODES))
        sums = outward.new_zeros(len(nodal), hexahedra.num_nodes, 3, 3)
        sums.index_add_(1, nodes.flatten(), (outward.flatten(2, 4) * share[..., None, None]).flatten(1, 2))
        total_share = share.new_zeros(hexahedra.num_nodes).index_add_(0, nodes.flatten(), share.flatten())
        return cls(hexahedra, trusted, sums / total_share.clamp_min(torch.finfo(total_share.dtype).tiny)[:, None, None])

    def at(self, points: Tensor) -> Tensor:
        """Stresses (L, P, 3, 3) at points (P, 3) in the implant's frame, N/mm^2, in its axes."""
        cube, inside = self.hexahedra.locate(points, self.trusted)
        inside = inside.clamp(-_BEYOND, _BEYOND)
        straight = [torch.stack([1 - x, 1 + x], dim=-1) / 2 for x in inside[:, 1:].unbind(-1)]
        shares = torch.einsum("pi,pj,pk->pijk", quadratics(inside)[:, 0], *straight).flatten(1)
        return torch.einsum("pc,lpcij->lpij", shares, self.nodal[:, self.hexahedra.nodes[:, list(_NODES)][cube]])


def von_mises(stress: Tensor) -> Tensor:
    """Von Mises equivalent stress (...) of stresses (..., 3, 3): metal yields where it reaches the yield stress."""
    return (1.5 * deviator(stress).square().sum((-2, -1))).sqrt()


def deviator(stress: Tensor) -> Tensor:
    """Deviatoric part (..., 3, 3) of stresses: without their mean pressure."""
    pressure = stress.diagonal(dim1=-2, dim2=-1).mean(-1)
    return stress - pressure[..., None, None] * torch.eye(3, dtype=stress.dtype, device=stress.device)


def _lines(ends: Tensor) -> Tensor:
    """Matrix (2, 2) that extrapolates values at two Barlow points linearly to both ends (2,) of a cube's edge."""
    return 0.5 * (1 + math.sqrt(3) * torch.outer(ends, ends))


def _through(hexahedra: Hexahedra, trusted: Tensor, samples: Tensor) -> Tensor:
    """Values (L, E, 3, 2, 2, ...) at the ends and the middle of the cubes, fitted through the thickness.

    Args:
        hexahedra: The E cubes.
        trusted: Mask (E,) of the cubes whose values are used.
        samples: Values (L, E, 2, 2, 2, ...) at the Barlow points.
    """
    neighbours = torch.stack([hexahedra.neighbours(0, step) for step in (-1, 0, 1)], dim=1)  # (E, 3)
    counts = (neighbours >= 0) & trusted[neighbours]
    counts[:, 1] = True
    steps = torch.tensor([-2.0, 0.0, 2.0], dtype=samples.dtype, device=samples.device)
    places = (steps[:, None] + steps[[0, 2]] / (2 * math.sqrt(3))).flatten()  # (6,), in half edges
    terms = torch.stack([torch.ones_like(places), places, places**2], dim=-1)
    target_terms = torch.stack([torch.ones_like(steps), steps / 2, (steps / 2) ** 2], dim=-1)
    fitted = torch.zeros_like(samples[:, :, :1]).repeat_interleave(3, 2)
    for pattern in torch.unique(counts, dim=0):
        cubes = (counts == pattern).all(1).nonzero().flatten()
        used = pattern.repeat_interleave(2)
        order = min(3, int(used.sum()))  # a straight line if there are only two points
        weights = target_terms[:, :order] @ torch.linalg.pinv(terms[:, :order] * used[:, None])
        values = samples[:, neighbours[cubes]].flatten(2, 3)
        fitted[:, cubes] = torch.einsum("tg,leg...->let...", weights * used, values)
    return fitted


def _stresses(slopes: Tensor, constants: ElasticConstants) -> Tensor:
    """Stresses (..., 3, 3) from displacement gradients (..., 3, 3), d u_i / d x_j (Hooke's law)."""
    strain = 0.5 * (slopes + slopes.mT)
    lame, shear = constants.lame
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    identity = torch.eye(3, dtype=strain.dtype, device=strain.device)
    return lame * trace[..., None, None] * identity + 2 * shear * strain

"""Stresses of an elastic body out of the displacements of its hexahedra's nodes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics.hexahedra import Hexahedra
from torchkcreg.physics import ElasticConstants

_CORNERS = (0, 2, 6, 8, 18, 20, 24, 26)  # of a cube's 27 nodes
_FULL_ENOUGH = 0.5  # of a cube that is full: what is in it then holds all of its shape functions
_BEYOND = 2.0  # half edges from a cube's middle, as far as its stresses go on


def volumes_in_cubes(hexahedra: Hexahedra, cloud: ImplantPointCloud) -> Tensor:
    """How much of an implant is in each cube, shape (E,), mm^3."""
    cube, _ = hexahedra.locate(cloud.points)
    volumes = cloud.volumes.double()
    return volumes.new_zeros(len(hexahedra.cells)).index_add_(0, cube, volumes)


def stresses(
    hexahedra: Hexahedra, filled: Tensor, constants: ElasticConstants, points: Tensor, nodal: Tensor
) -> Tensor:
    """Stresses (L, P, 3, 3) at points of an implant, N/mm^2, in its axes.

    Taken where quadratic shape functions know them best, at the 2 x 2 x 2 places of Barlow (1976) in each cube,
    extrapolated to the cubes' corners, averaged there over the metal, and linear in between. Cubes that hold little
    metal leave some of their shape functions free and do not take part: what is in them has the stress of the nearest
    cube that does, continued.

    Args:
        hexahedra: Around the implant.
        filled: How much of it is in each cube, shape (E,).
        constants: Of its alloy.
        points: In its frame, shape (P, 3), mm.
        nodal: Displacements of the hexahedra's nodes, shape (L, N, 3), mm.
    """
    ends = torch.tensor([-1.0, 1.0], dtype=torch.float64, device=nodal.device)
    corners = torch.cartesian_prod(ends, ends, ends)
    _, slopes = hexahedra.shape_functions(corners / math.sqrt(3))
    nodal = nodal.double()
    gradients = torch.einsum("gaj,leai->legij", slopes, nodal[:, hexahedra.nodes]) @ hexahedra.frame[:3, :3].mT
    outward = torch.einsum("cg,legij->lecij", _trilinear(corners * math.sqrt(3)), _stresses(gradients, constants))
    nodes, trusted = hexahedra.nodes[:, list(_CORNERS)], filled >= _FULL_ENOUGH * filled.max()
    share = (filled * trusted)[:, None].expand(nodes.shape)
    sums = outward.new_zeros(len(nodal), hexahedra.num_nodes, 3, 3)
    sums.index_add_(1, nodes.flatten(), (outward * share[..., None, None]).flatten(1, 2))
    whole = share.new_zeros(hexahedra.num_nodes).index_add_(0, nodes.flatten(), share.flatten())
    mean = sums / whole.clamp_min(torch.finfo(whole.dtype).tiny)[:, None, None]
    cube, inside = hexahedra.locate(points, trusted)
    return torch.einsum("pc,lpcij->lpij", _trilinear(inside.clamp(-_BEYOND, _BEYOND)), mean[:, nodes[cube]])


def von_mises(stress: Tensor) -> Tensor:
    """Equivalent stress (...) of stresses (..., 3, 3): metal yields where it reaches the yield stress."""
    trace = stress.diagonal(dim1=-2, dim2=-1).sum(-1)
    deviator = stress - trace[..., None, None] / 3 * torch.eye(3, dtype=stress.dtype, device=stress.device)
    return (1.5 * deviator.square().sum((-2, -1))).sqrt()


def _stresses(slopes: Tensor, constants: ElasticConstants) -> Tensor:
    """Of displacement gradients (..., 3, 3), d u_i / d x_j (Hooke's law)."""
    strain = 0.5 * (slopes + slopes.mT)
    lame, shear = constants.lame
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    same = torch.eye(3, dtype=strain.dtype, device=strain.device)
    return lame * trace[..., None, None] * same + 2 * shear * strain


def _trilinear(inside: Tensor) -> Tensor:
    """Weights (P, 8) of a cube's corners at places (P, 3) in it, from -1 to 1."""
    ends = torch.stack([1 - inside, 1 + inside], dim=-1) / 2
    return torch.einsum("pi,pj,pk->pijk", *ends.unbind(1)).flatten(1)

"""Stiffness of an implant as a matrix over the nodes of hexahedra that need not follow its surface."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants

from .hexahedra import NODES, Hexahedra

_FILLING = 1e-7  # of the metal's stiffness: what the rest of a cube is made of
_PLACES = 5


def stiffness_matrix(hexahedra: Hexahedra, cloud: ImplantPointCloud, constants: ElasticConstants) -> csr_array:
    """Stiffness (3 N, 3 N), N/mm, of the displacements of the hexahedra's nodes, in the lattice's frame.

    Finite cells (Parvizian, Duester and Rank 2007): the metal in a cube is integrated over the implant's own nodes,
    each with its volume at its centroid, so that a cube's surface need not be the implant's: ``sum_n V_n B_n^T D B_n``.

    Args:
        hexahedra: Around the implant.
        cloud: The implant; nodes of a tenth of its thickness or less.
        constants: Of its alloy.
    """
    places, whole = _gauss_points(hexahedra.positions)
    weights = _fitted_weights(hexahedra, cloud, places) + _FILLING * hexahedra.edge**3 * whole
    _, gradients = hexahedra.shape_functions(torch.cartesian_prod(places, places, places))
    flat = gradients.flatten(1)
    products = weights @ (flat[:, :, None] * flat[:, None, :]).flatten(1)  # sums of dN_a/dx_i dN_b/dx_j
    return _assembled(hexahedra, _elastic(products.unflatten(-1, (NODES, 3, NODES, 3)), constants))


def _gauss_points(like: Tensor) -> tuple[Tensor, Tensor]:
    """Five points of Gauss and Legendre from -1 to 1, and the weights (125,) of a whole cube's, which sum to one."""
    places, weights = (like.new_tensor(x) for x in np.polynomial.legendre.leggauss(_PLACES))
    return places, torch.einsum("i,j,k->ijk", weights, weights, weights).flatten() / 8


def _fitted_weights(hexahedra: Hexahedra, cloud: ImplantPointCloud, places: Tensor) -> Tensor:
    """Weights (E, 125) of the points of Gauss in each cube that integrate over the metal in it (moment fitting).

    The products of two quadratic shape functions' slopes are polynomials of degree 4 along each axis: they are known at
    five places, and their integral over any metal is the sum over these with weights ``w_g = sum_n V_n L_g(x_n)``.
    """
    cube, inside = hexahedra.locate(cloud.points)
    order = cube.argsort(stable=True)
    volumes, values = cloud.volumes.double()[order], _lagrange(inside[order], places)
    counts = torch.bincount(cube, minlength=len(hexahedra.cells)).tolist()
    weights = [
        torch.einsum("n,ni,nj,nk->ijk", v, *some.unbind(1)).flatten()
        for v, some in zip(volumes.split(counts), values.split(counts), strict=True)
    ]
    return torch.stack(weights)


def _lagrange(inside: Tensor, places: Tensor) -> Tensor:
    """Values (P, 3, 5) at coordinates (P, 3) of the polynomials that are 1 at one place and 0 at the others."""
    factors = []
    for here in range(len(places)):
        others = [there for there in range(len(places)) if there != here]
        factors.append(torch.stack([(inside - places[o]) / (places[here] - places[o]) for o in others]).prod(0))
    return torch.stack(factors, dim=-1)


def _elastic(products: Tensor, constants: ElasticConstants) -> Tensor:
    """Stiffness (E, 81, 81) of cubes: lambda div u div v + 2 mu eps(u) : eps(v)."""
    lame, shear = constants.lame
    stiffness = lame * products + shear * products.transpose(2, 4)
    laplacian = products.diagonal(dim1=2, dim2=4).sum(-1)
    stiffness.diagonal(dim1=2, dim2=4).add_(shear * laplacian[..., None])
    return stiffness.flatten(1, 2).flatten(2)


def _assembled(hexahedra: Hexahedra, blocks: Tensor) -> csr_array:
    owners = (3 * hexahedra.nodes[..., None] + torch.arange(3, device=blocks.device)).flatten(1).cpu().numpy()
    rows = np.repeat(owners, owners.shape[1], axis=1).ravel()
    columns = np.tile(owners, (1, owners.shape[1])).ravel()
    size = 3 * hexahedra.num_nodes
    return coo_array((blocks.cpu().numpy().ravel(), (rows, columns)), shape=(size, size)).tocsr()

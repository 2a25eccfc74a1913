"""Stiffness matrix of an implant on hexahedra that need not follow its surface (finite cell method)."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from torchkcreg.geometry import invert_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import ElasticConstants

from .hexahedra import NODES, Hexahedra

_FILLING = 1e-7  # of the metal's stiffness: stiffness of the empty part of a cube
_PLACES = 5
_THINNEST = 1e-3  # of a cell: thinner parts are not cut off


def stiffness_matrix(hexahedra: Hexahedra, cloud: ImplantPointCloud, constants: ElasticConstants) -> csr_array:
    """Stiffness matrix (3 N, 3 N), N/mm, for the hexahedra's nodes, in the lattice's frame.

    Finite cell method (Parvizian, Duester and Rank 2007): the metal in a cube is integrated over the nodes of the point
    cloud, each with its volume at its centroid, `sum_n V_n B_n^T D B_n`. The cubes thus need not follow the surface.

    Args:
        hexahedra: Hexahedra around the implant.
        cloud: The implant, with a node spacing of at most a tenth of its thickness.
        constants: Elastic constants of its alloy.
    """
    places, whole = _gauss_points(hexahedra.positions)
    weights = _fitted_weights(hexahedra, cloud, places) + _FILLING * hexahedra.edge**3 * whole
    _, gradients = hexahedra.shape_functions(torch.cartesian_prod(places, places, places))
    flat = gradients.flatten(1)
    products = weights @ (flat[:, :, None] * flat[:, None, :]).flatten(1)  # sums of dN_a/dx_i dN_b/dx_j
    return _assembled(hexahedra, _elastic(products.unflatten(-1, (NODES, 3, NODES, 3)), constants))


def _gauss_points(like: Tensor) -> tuple[Tensor, Tensor]:
    """Five Gauss-Legendre points from -1 to 1, and the weights (125,) for a full cube, which sum to one."""
    places, weights = (like.new_tensor(x) for x in np.polynomial.legendre.leggauss(_PLACES))
    return places, torch.einsum("i,j,k->ijk", weights, weights, weights).flatten() / 8


def _fitted_weights(hexahedra: Hexahedra, cloud: ImplantPointCloud, places: Tensor) -> Tensor:
    """Weights (E, 125) of the Gauss points in each cube for integration over the metal in it (moment fitting).

    Products of two gradients of quadratic shape functions are polynomials of degree 4 along each axis, so five points
    determine them. Their integral over the metal is the sum over these with weights `w_g = sum_n V_n L_g(x_n)`. Each
    node stands for the metal in its cell, which is cut at the cubes' faces: as a point it would lack its second moment,
    and a plate of thickness t would be too soft by (pitch / t)^2.
    """
    centers, halves, volumes = _boxes(hexahedra, cloud)
    cube, inside = hexahedra.locate(transform_points(hexahedra.frame, centers))
    order = cube.argsort(stable=True)
    reach = 2 * halves[order] / hexahedra.edge / math.sqrt(3)
    near = [_lagrange(inside[order] + side * reach, places) for side in (-1, 1)]  # two Gauss points along each axis
    counts = torch.bincount(cube, minlength=len(hexahedra.cells)).tolist()
    weights = [
        torch.einsum("n,ni,nj,nk->ijk", chunk_volumes, *chunk.unbind(1)).flatten()
        for chunk_volumes, chunk in zip(
            volumes[order].split(counts), ((near[0] + near[1]) / 2).split(counts), strict=True
        )
    ]
    return torch.stack(weights)


def _boxes(hexahedra: Hexahedra, cloud: ImplantPointCloud) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes of metal along the lattice's axes: centres and half edges (P, 3), mm, and volumes (P,), mm^3.

    There is one for each node, or several where its cell reaches into several cubes. A node at the surface has the box
    between the cell's far sides whose middle is the node, scaled to its volume.
    """
    in_cells, volumes = cloud.in_cells(), cloud.volumes.double()
    extents = (1 - 2 * (in_cells - in_cells.round()).abs()).clamp_min(_THINNEST)
    extents = extents * (cloud.filled / extents.prod(1))[:, None] ** (1 / 3)
    along = (
        cloud.cell.double() @ hexahedra.frame[:3, :3]
    ).square()  # squared edges in the lattice's axes: second moments add
    halves = (extents.square() @ along).sqrt() / 2
    centers = transform_points(invert_rigid(hexahedra.frame), cloud.points.double())
    for axis in range(3):
        low, high = centers[:, axis] - halves[:, axis], centers[:, axis] + halves[:, axis]
        face = ((low / hexahedra.edge).floor() + 1) * hexahedra.edge
        cut = high - face > _THINNEST * cloud.pitch
        share = ((high - face) / (high - low))[cut]
        beyond, beyond_halves = centers[cut].clone(), halves[cut].clone()
        beyond[:, axis], beyond_halves[:, axis] = (face + high)[cut] / 2, (high - face)[cut] / 2
        centers[cut, axis], halves[cut, axis] = (low + face)[cut] / 2, (face - low)[cut] / 2
        beyond_volumes, volumes = volumes[cut] * share, volumes.masked_scatter(cut, volumes[cut] * (1 - share))
        centers, halves = torch.cat([centers, beyond]), torch.cat([halves, beyond_halves])
        volumes = torch.cat([volumes, beyond_volumes])
    return centers, halves, volumes


def _lagrange(inside: Tensor, places: Tensor) -> Tensor:
    """Lagrange polynomials (P, 3, 5) for the given places at coordinates (P, 3): 1 at one place, 0 at the others."""
    factors = []
    for index in range(len(places)):
        others = [k for k in range(len(places)) if k != index]
        factors.append(torch.stack([(inside - places[k]) / (places[index] - places[k]) for k in others]).prod(0))
    return torch.stack(factors, dim=-1)


def _elastic(products: Tensor, constants: ElasticConstants) -> Tensor:
    """Stiffness matrices (E, 81, 81) of the cubes: lambda div u div v + 2 mu eps(u) : eps(v)."""
    lame, shear = constants.lame
    stiffness = lame * products + shear * products.transpose(2, 4)
    laplacian = products.diagonal(dim1=2, dim2=4).sum(-1)
    stiffness.diagonal(dim1=2, dim2=4).add_(shear * laplacian[..., None])
    return stiffness.flatten(1, 2).flatten(2)


def _assembled(hexahedra: Hexahedra, blocks: Tensor) -> csr_array:
    degrees = (3 * hexahedra.nodes[..., None] + torch.arange(3, device=blocks.device)).flatten(1).cpu().numpy()
    rows = np.repeat(degrees, degrees.shape[1], axis=1).ravel()
    columns = np.tile(degrees, (1, degrees.shape[1])).ravel()
    size = 3 * hexahedra.num_nodes
    return coo_array((blocks.cpu().numpy().ravel(), (rows, columns)), shape=(size, size)).tocsr()

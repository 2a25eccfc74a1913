"""Bodies of an implant that do not touch: elements that bridge the air between them would glue them together."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchkcreg.implant import ImplantPointCloud

_LESS = 0.995  # a cell with less than this share of its neighbours' metal on both sides holds air between them
_CRUMB = 0.01  # of the volume: smaller bodies are noise of a mesh or of a bench scan


def body_volumes(cloud: ImplantPointCloud) -> list[float]:
    """Volumes, mm^3, of the bodies that a point cloud consists of, the largest first; crumbs are not counted.

    Neighbouring nodes of the lattice belong together. A node, or two in a row, with less metal than the neighbours on
    both sides along an axis holds a gap, even if that is narrower than a cell: it connects nothing, and does not count.
    Gaps oblique to the lattice are seen from about two cells on; a mesh tells them all (`num_shells`).

    >>> import trimesh
    >>> plate = trimesh.creation.box((6.0, 2.0, 20.0))
    >>> pair = trimesh.util.concatenate([plate, plate.copy().apply_translation([0.0, 2.1, 0.0])])
    >>> [round(volume) for volume in body_volumes(ImplantPointCloud.from_mesh(pair, 0.5))]
    [240, 192]
    """
    filled = cloud.filled.detach().cpu().numpy()
    index = cloud.in_cells().detach().cpu().round().long().numpy()
    index -= index.min(0) - 2
    shape = tuple(index.max(0) + 3)
    number = np.full(shape, -1)
    number[tuple(index.T)] = np.arange(len(index))
    metal = np.where(number >= 0, filled[number], 0.0)
    solid = (number >= 0) & ~np.logical_or.reduce([_gaps(metal, axis) for axis in range(3)])
    pairs = []
    for axis in range(3):
        along, here = np.moveaxis(number, axis, 0), np.moveaxis(solid, axis, 0)
        both = here[:-1] & here[1:]
        pairs.append(np.stack([along[:-1][both], along[1:][both]]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(len(index), len(index)))
    volumes = cloud.volumes.detach().double().cpu().numpy()
    sizes = np.bincount(connected_components(graph, directed=False)[1], weights=volumes)
    return sorted((float(size) for size in sizes if size > _CRUMB * sizes.sum()), reverse=True)


def separate_bodies(number: int) -> str:
    """Message about an implant of several bodies, and what helps."""
    return (
        f"the implant is {number} bodies that do not touch: register each as an implant of its own, or bend it with "
        "--deformation modes."
    )


def num_shells(mesh: trimesh.Trimesh) -> int:
    """Number of bodies of a closed mesh: shells that no other contains, without crumbs. Shells do not overlap."""
    volumes = np.array([shell.volume for shell in mesh.split(only_watertight=False)])
    return max(1, int((volumes > _CRUMB * abs(mesh.volume)).sum()))


def _gaps(metal: NDArray[np.float64], axis: int) -> NDArray[np.bool_]:
    """True for cells that hold air between the metal on both sides of them along an axis."""
    along = np.moveaxis(metal, axis, 0)
    gap = np.zeros(along.shape, dtype=bool)
    gap[1:-1] = along[1:-1] < _LESS * np.minimum(along[:-2], along[2:])
    pair = np.maximum(along[1:-2], along[2:-1]) < _LESS * np.minimum(along[:-3], along[3:])
    gap[1:-2] |= pair
    gap[2:-1] |= pair
    return np.moveaxis(gap, 0, axis)

"""`ImplantPointCloud`: an implant as nodes, the volume each stands for, and the lattice cell it fills."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
import torch
import trimesh
from torch import Tensor, nn

from torchkcreg.geometry import VolumeGrid, transform_points

from .closed_mesh import closed_triangles
from .partial_volumes import fill_cells

_BITS = 21  # three coordinates of 21 bits fill an int64 without its sign
_NEGLIGIBLE = 1e-6  # fraction of a cell below which a node is not worth its time


def morton_order(points: Tensor, cell: Tensor) -> Tensor:
    """Permutation (N,) that sorts points (N, 3) along the z-curve of a lattice with cell edges (3, 3) in rows.

    Any stretch of the sorted points is compact, so a block of them shares one footprint and one patch of the detector.
    Points of the same cell keep their order.

    Raises:
        ValueError: the points span more than 2^21 cells.

    >>> morton_order(torch.tensor([[3.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 1.5, 0.5]]), torch.eye(3)).tolist()
    [1, 2, 0]
    """
    in_cells = points.detach().double() @ torch.linalg.inv(cell.detach().double())
    # a small shift, so that a lattice of rounded coordinates does not fall on both sides of the cell faces
    indices = torch.floor(in_cells - in_cells.amin(0) + 0.25).long()
    if bool((indices >= 1 << _BITS).any()):
        raise ValueError(
            f"points must span fewer than {1 << _BITS} cells along each axis, got {indices.amax(0).tolist()}"
        )
    spread = _spread_bits(torch.arange(int(indices.max()) + 1, device=indices.device))  # a table: far fewer than points
    code = torch.zeros_like(indices[:, 0])
    for axis in range(3):
        code |= spread[indices[:, axis]] << axis
    return torch.argsort(code, stable=True)


def _spread_bits(value: Tensor) -> Tensor:
    """Bits b20 ... b1 b0 moved apart to b20 0 0 ... b1 0 0 b0."""
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        value = (value | (value << shift)) & mask
    return value


class ImplantPointCloud(nn.Module):
    """Nodes of an implant in its own frame, with volumes; in Morton order, so that neighbours are close in memory.

    A node stands for a parallelepiped, the cell of the lattice it comes from, and holds ``volumes`` mm^3 of metal.
    Volumes, not attenuation: a projection of the cloud is a path length in mm, and materials enter later.

    Args:
        points: (N, 3) in mm, in any order; the buffers hold them in Morton order.
        volumes: (N,) in mm^3, not negative.
        cell: (3, 3), rows are the edge vectors of a cell in mm.

    Attributes:
        points: buffer (N, 3).
        volumes: buffer (N,).
        cell: buffer (3, 3).

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite, negative volumes, or a flat cell.

    >>> cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((2.0, 3.0, 10.0)), pitch=0.5)
    >>> cloud
    ImplantPointCloud(num_nodes=480, volume=60 mm^3, cell=0.5 x 0.5 x 0.5 mm)
    """

    points: Tensor
    volumes: Tensor
    cell: Tensor

    def __init__(self, points: Tensor, volumes: Tensor, cell: Tensor) -> None:
        super().__init__()
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise ValueError(f"points must have shape (N, 3) with N > 0, got {tuple(points.shape)}")
        if volumes.shape != points.shape[:1]:
            raise ValueError(f"volumes must have shape ({len(points)},), got {tuple(volumes.shape)}")
        if cell.shape != (3, 3):
            raise ValueError(f"cell must have shape (3, 3), got {tuple(cell.shape)}")
        for name, tensor in (("points", points), ("volumes", volumes), ("cell", cell)):
            if not tensor.is_floating_point() or not bool(tensor.isfinite().all()):
                raise ValueError(f"{name} must be finite floating-point numbers, got {tensor.dtype}")
        if bool((volumes < 0).any()):
            raise ValueError(f"volumes must not be negative, got {volumes.min().item()}")
        if not bool(torch.linalg.det(cell.double()).abs() > 0):
            raise ValueError(f"cell must have a volume, got edges {cell.tolist()}")
        order = morton_order(points, cell.to(points.device))
        self.register_buffer("points", points[order])
        self.register_buffer("volumes", volumes.to(points)[order])
        self.register_buffer("cell", cell.to(points))
        self._coarser: dict[tuple[int, ...], ImplantPointCloud] = {}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ImplantPointCloud:
        self._coarser = {}
        super()._apply(fn, recurse)
        return self

    def mapped(self, linear: Tensor, shift: Tensor) -> ImplantPointCloud:
        """The cloud after ``x -> x linear + shift``, its nodes in the same order; volumes follow the determinant."""
        other = copy.copy(self)
        other._buffers = {
            "points": shift + self.points @ linear,
            "volumes": self.volumes * torch.linalg.det(linear).abs(),
            "cell": self.cell @ linear,
        }
        other._coarser = {}
        return other

    @classmethod
    def from_mesh(
        cls,
        mesh: trimesh.Trimesh,
        pitch: float = 0.25,
        *,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        at_centroids: bool = True,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> ImplantPointCloud:
        """Cloud of a closed surface in mm: nodes on a cubic lattice along the axes of the mesh's own frame.

        Nodes stand at the centres of cells, ``origin + (i + 1/2) pitch``, and hold exactly the volume that the mesh has
        in their cell, partial at the surface; together, the mesh's volume.

        Args:
            mesh: closed, in mm. Inverted or mixed winding is repaired on a copy.
            pitch: edge of a cell, mm.
            origin: a corner of the lattice.
            at_centroids: put each node at the centroid of the metal in its cell, instead of the centre of the cell.
                First moments are then exact too, so that edges come out about ten times closer to those of the mesh
                (in 1 - NCC of their gradients), but the lattice is irregular at the surface.
            dtype: of the buffers.
            device: of the buffers.

        Raises:
            ValueError: the mesh is open or overlaps itself, or pitch is not positive.
        """
        if not (np.isfinite(pitch) and pitch > 0):
            raise ValueError(f"pitch must be a positive length in mm, got {pitch}")
        corner = np.asarray(origin, dtype=np.float64)
        if corner.shape != (3,) or not np.isfinite(corner).all():
            raise ValueError(f"origin must be three finite numbers in mm, got {origin}")
        triangles = (closed_triangles(mesh) - corner) / pitch
        indices, fractions, centroids = fill_cells(triangles)
        if fractions.min() < -1e-6 or fractions.max() > 1 + 1e-6:
            extremes = f"{fractions.min():.3g} to {fractions.max():.3g}"
            raise ValueError(f"mesh must not overlap itself, but its cells are filled {extremes} times")
        kept = fractions > _NEGLIGIBLE
        if not kept.any():  # smaller than a cell by far
            kept = fractions > 0
        within = centroids[kept] if at_centroids else 0.5
        volumes = fractions[kept] * pitch**3
        points = corner + (indices[kept] + within) * pitch
        buffers = (torch.from_numpy(array).to(device, dtype) for array in (points, volumes, pitch * np.eye(3)))
        return cls(*buffers)

    @classmethod
    def from_volume(
        cls,
        volume: Tensor,
        grid: VolumeGrid,
        *,
        threshold: float,
        metal_value: float,
        dtype: torch.dtype = torch.float32,
    ) -> ImplantPointCloud:
        """Cloud of the voxels of a reconstruction above a threshold, as in Cao et al. 2020 (section 2.4).

        A voxel at the surface is part metal, part air, and its value says how much of each: its node holds the voxel's
        volume times ``value / metal_value``, at most one. So the threshold should lie well below the metal, just above
        noise and artefacts; at half the metal's value each surface loses the lighter half of its voxels.

        Args:
            volume: (D, H, W), attenuation or any unit linear in it, air at zero.
            grid: where its voxels are.
            threshold: value above which a voxel is kept.
            metal_value: value of solid metal in the same unit.
            dtype: of the buffers, which are on the volume's device.

        Raises:
            ValueError: shapes differ, not ``0 <= threshold < metal_value``, or nothing is above the threshold.
        """
        if tuple(volume.shape) != grid.shape:
            raise ValueError(f"volume must have the grid's shape {grid.shape}, got {tuple(volume.shape)}")
        if not 0 <= threshold < metal_value:
            raise ValueError(f"threshold must satisfy 0 <= threshold < metal_value, got {threshold} and {metal_value}")
        kept = (volume > threshold).nonzero()
        if len(kept) == 0:
            raise ValueError(f"volume must exceed the threshold {threshold} somewhere, its maximum is {volume.max()}")
        points = transform_points(grid.voxel_to_world.to(volume.device), kept.flip(1).double())
        share = (volume[kept[:, 0], kept[:, 1], kept[:, 2]].double() / metal_value).clamp(0, 1)
        cell = grid.voxel_to_world[:3, :3].mT.to(volume.device)
        return cls(points.to(dtype), (share * grid.voxel_volume).to(dtype), cell.to(dtype))

    def extra_repr(self) -> str:
        edges = " x ".join(f"{edge:.4g}" for edge in self.cell.norm(dim=1).tolist())
        return f"num_nodes={self.num_nodes}, volume={self.volume:.6g} mm^3, cell={edges} mm"

    @property
    def num_nodes(self) -> int:
        """Number of nodes N."""
        return len(self.points)

    @property
    def volume(self) -> float:
        """Volume of the implant in mm^3, the sum of the volumes."""
        return self.volumes.detach().double().sum().item()

    @property
    def bounds(self) -> Tensor:
        """Smallest and largest coordinates of the nodes, (2, 3) in mm; cells reach half an edge further."""
        return torch.stack([self.points.amin(0), self.points.amax(0)])

    @property
    def pitch(self) -> float:
        """Edge in mm of a cube as large as a cell."""
        return torch.linalg.det(self.cell.double()).abs().item() ** (1 / 3)

    def coarsened_to(self, pitch: float) -> ImplantPointCloud:
        """The cloud on a lattice of about this pitch in mm, or as it is where that is finer; see `coarsened`."""
        factor = max(1, round(pitch / self.pitch))
        return self if factor == 1 else self.coarsened(factor)

    def coarsened(self, factor: int) -> ImplantPointCloud:
        """Cloud on a lattice ``factor`` times as coarse: the nodes of ``factor^3`` cells merge at their centroid.

        Volumes and centroids are exact, for fast first stages of a registration. Made once and kept: leave it as it is.
        """
        if int(factor) != factor or factor < 1:
            raise ValueError(f"factor must be a positive integer, got {factor}")
        buffers = (self.points, self.volumes, self.cell)
        versions = (0 if b.is_inference() else b._version for b in buffers)  # inference tensors have none
        key = (int(factor), *(b.data_ptr() for b in buffers), *versions)
        if key not in self._coarser:
            self._coarser = {kept: cloud for kept, cloud in self._coarser.items() if kept[1:] == key[1:]}
            self._coarser[key] = self._coarsened(int(factor))
        return self._coarser[key]

    def _coarsened(self, factor: int) -> ImplantPointCloud:
        in_cells = self.points.double() @ torch.linalg.inv(self.cell.double())
        # The heaviest node's cell is full, so that it stands at its centre: surface nodes lie anywhere in theirs.
        lattice = torch.round(in_cells - in_cells[self.volumes.argmax()]).long()
        blocks = torch.div(lattice - lattice.amin(0), factor, rounding_mode="floor")
        size = blocks.amax(0) + 1
        distinct, block = torch.unique(
            (blocks[:, 0] * size[1] + blocks[:, 1]) * size[2] + blocks[:, 2], return_inverse=True
        )
        volumes = self.volumes.double()
        # nodes without volume still have a place
        weights = volumes.clamp_min(1e-12 * volumes.max().clamp_min(1e-300))
        totals = torch.zeros(len(distinct), dtype=torch.float64, device=volumes.device).index_add(0, block, weights)
        moments = totals.new_zeros(len(distinct), 3).index_add(0, block, weights[:, None] * self.points.double())
        merged = torch.zeros_like(totals).index_add(0, block, volumes)
        return ImplantPointCloud(*(t.to(self.points) for t in (moments / totals[:, None], merged, self.cell * factor)))

    def principal_axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centre of mass (3,), principal axes (3, 3) in rows and extents (3,) of the nodes along them, in mm.

        Axes go from the smallest to the largest variance: the third one runs along a plate. The largest component of
        the second and the third axis is positive, and the first one makes the axes a proper rotation.
        """
        points, volumes = self.points.double(), self.volumes.double()
        share = (volumes / volumes.sum())[:, None]
        center = (share * points).sum(0)
        centred = points - center
        _, vectors = torch.linalg.eigh((share * centred).mT @ centred)
        axes = vectors.mT
        largest = (axes.abs() > axes.abs().amax(1, keepdim=True) - 1e-6).long().argmax(1)  # the first, of equals
        axes = axes * axes.gather(1, largest[:, None]).sign()
        axes = torch.cat([torch.linalg.det(axes).sign() * axes[:1], axes[1:]])
        along = centred @ axes.mT
        extents = along.amax(0) - along.amin(0)
        return center.to(self.points), axes.to(self.points), extents.to(self.points)

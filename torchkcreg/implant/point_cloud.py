"""Point cloud of an implant (`ImplantPointCloud`): nodes with metal volumes, on a lattice; Morton order of points."""

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
_NEGLIGIBLE = 1e-6  # nodes that fill a smaller fraction of their cell are dropped


def morton_order(points: Tensor, cell: Tensor) -> Tensor:
    """Permutation (N,) that sorts points (N, 3) along the z-curve of a lattice with cell edges (3, 3) in rows.

    Consecutive points are close together, so a block of them shares one footprint and one patch of the detector. Points
    in the same cell keep their order.

    Raises:
        ValueError: If the points span more than 2^21 cells.

    >>> morton_order(torch.tensor([[3.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 1.5, 0.5]]), torch.eye(3)).tolist()
    [1, 2, 0]
    """
    in_cells = points.detach().double() @ torch.linalg.inv(cell.detach().double())
    # shifted a little, so that rounded lattice coordinates do not fall on both sides of the cell faces
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
    """Spread bits b20 ... b1 b0 to b20 0 0 ... b1 0 0 b0."""
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
    """Nodes of an implant in the implant's frame, with metal volumes, in Morton order for memory locality.

    A node represents a lattice cell (a parallelepiped) that contains `volumes` mm^3 of metal. Because nodes have
    volumes instead of attenuation, a projection of the cloud is a path length in mm; materials are applied later.

    Args:
        points: (N, 3) in mm, in any order; the buffers are in Morton order.
        volumes: (N,) in mm^3, not negative.
        cell: (3, 3), rows are the edge vectors of a cell in mm.

    Attributes:
        points: Buffer (N, 3).
        volumes: Buffer (N,).
        cell: Buffer (3, 3).

    Raises:
        ValueError: If shapes do not fit, numbers are not finite, volumes are negative, or the cell is flat.

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
        """The cloud after `x -> x linear + shift`, nodes in the same order, volumes scaled by the determinant."""
        mapped_cloud = copy.copy(self)
        mapped_cloud._buffers = {
            "points": shift + self.points @ linear,
            "volumes": self.volumes * torch.linalg.det(linear).abs(),
            "cell": self.cell @ linear,
        }
        mapped_cloud._coarser = {}
        return mapped_cloud

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
        """Cloud of a closed surface in mm: nodes on a cubic lattice along the axes of the mesh's frame.

        Nodes are at the centres of cells, `origin + (i + 1/2) pitch`, and have exactly the volume of the mesh in their
        cell (partial at the surface). Their sum is the mesh's volume.

        Args:
            mesh: Closed surface in mm. Inverted or mixed winding is repaired on a copy.
            pitch: Edge length of a cell, mm.
            origin: Corner of the lattice, mm.
            at_centroids: Put each node at the centroid of the metal in its cell instead of the centre of the cell.
                First moments are then exact too, and projected edges are about ten times closer to those of the mesh
                (in 1 - NCC of their gradients), but the lattice is irregular at the surface.
            dtype: Dtype of the buffers.
            device: Device of the buffers.

        Raises:
            ValueError: If the mesh is open or overlaps itself, or pitch is not positive.
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
        used = fractions > _NEGLIGIBLE
        if not used.any():  # the whole mesh is much smaller than a cell
            used = fractions > 0
        within = centroids[used] if at_centroids else 0.5
        volumes = fractions[used] * pitch**3
        points = corner + (indices[used] + within) * pitch
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

        A voxel at the surface is part metal, part air, and its value measures the fraction of metal. Its node gets the
        voxel's volume times `value / metal_value`, clipped to one. The threshold should therefore lie well below the
        metal, just above noise and artefacts: at half the metal's value, surface voxels less than half full are lost.

        Args:
            volume: (D, H, W), attenuation or any unit linear in it, air at zero.
            grid: Voxel grid of the volume.
            threshold: Value above which a voxel is kept.
            metal_value: Value of solid metal in the same unit.
            dtype: Dtype of the buffers, which are on the volume's device.

        Raises:
            ValueError: If shapes differ, `0 <= threshold < metal_value` is violated, or no voxel exceeds the threshold.
        """
        if tuple(volume.shape) != grid.shape:
            raise ValueError(f"volume must have the grid's shape {grid.shape}, got {tuple(volume.shape)}")
        if not 0 <= threshold < metal_value:
            raise ValueError(f"threshold must satisfy 0 <= threshold < metal_value, got {threshold} and {metal_value}")
        metal_voxels = (volume > threshold).nonzero()
        if len(metal_voxels) == 0:
            raise ValueError(f"volume must exceed the threshold {threshold} somewhere, its maximum is {volume.max()}")
        points = transform_points(grid.voxel_to_world.to(volume.device), metal_voxels.flip(1).double())
        share = (volume[metal_voxels[:, 0], metal_voxels[:, 1], metal_voxels[:, 2]].double() / metal_value).clamp(0, 1)
        cell = grid.voxel_to_world[:3, :3].mT.to(volume.device)
        return cls(points.to(dtype), (share * grid.voxel_volume).to(dtype), cell.to(dtype))

    def extra_repr(self) -> str:
        """Number of nodes, volume and cell edges."""
        edges = " x ".join(f"{edge:.4g}" for edge in self.cell.norm(dim=1).tolist())
        return f"num_nodes={self.num_nodes}, volume={self.volume:.6g} mm^3, cell={edges} mm"

    @property
    def num_nodes(self) -> int:
        """Number of nodes N."""
        return len(self.points)

    @property
    def volume(self) -> float:
        """Volume of the implant, mm^3: the sum over the nodes."""
        return self.volumes.detach().double().sum().item()

    @property
    def bounds(self) -> Tensor:
        """Smallest and largest coordinates of the nodes, (2, 3), mm; cells extend half an edge further."""
        return torch.stack([self.points.amin(0), self.points.amax(0)])

    @property
    def pitch(self) -> float:
        """Edge of a cube with the volume of a cell, mm."""
        return torch.linalg.det(self.cell.double()).abs().item() ** (1 / 3)

    @property
    def filled(self) -> Tensor:
        """Share of its cell that the metal of each node fills, (N,), float64."""
        return self.volumes.double() / torch.linalg.det(self.cell.double()).abs()

    def in_cells(self) -> Tensor:
        """Positions of the nodes on their lattice, (N, 3), float64: whole numbers are the middles of cells.

        They are counted from the node with the most metal, whose cell is full, so that its node is its middle.
        """
        points = self.points.double()
        return (points - points[self.filled.argmax()]) @ torch.linalg.inv(self.cell.double())

    def gyration(self, pitch_mm: float = 1.0) -> tuple[Tensor, Tensor]:
        """Centre of mass (3,) and radius of gyration, mm, float64, of nodes merged to a pitch of `pitch_mm`."""
        coarse = self.coarsened_to(pitch_mm)
        points, share = coarse.points.double(), (coarse.volumes / coarse.volumes.sum()).double()[:, None]
        center = (share * points).sum(0)
        return center, (share * (points - center) ** 2).sum().sqrt()

    def coarsened_to(self, pitch: float) -> ImplantPointCloud:
        """The cloud on a lattice of about this pitch, mm; unchanged if it is not finer than that. See `coarsened`."""
        factor = max(1, round(pitch / self.pitch))
        return self if factor == 1 else self.coarsened(factor)

    def coarsened(self, factor: int) -> ImplantPointCloud:
        """Cloud on a lattice `factor` times as coarse: the nodes of `factor^3` cells are merged at their centroid.

        Volumes and centroids are exact. Useful for fast first stages of a registration. The result is cached: do not
        change it.
        """
        if int(factor) != factor or factor < 1:
            raise ValueError(f"factor must be a positive integer, got {factor}")
        buffers = (self.points, self.volumes, self.cell)
        versions = (0 if b.is_inference() else b._version for b in buffers)  # inference tensors have none
        key = (int(factor), *(b.data_ptr() for b in buffers), *versions)
        if key not in self._coarser:
            self._coarser = {
                cached_key: cloud for cached_key, cloud in self._coarser.items() if cached_key[1:] == key[1:]
            }
            self._coarser[key] = self._coarsened(int(factor))
        return self._coarser[key]

    def _coarsened(self, factor: int) -> ImplantPointCloud:
        in_cells = self.points.double() @ torch.linalg.inv(self.cell.double())
        # The heaviest node fills its cell and lies at its centre; surface nodes may lie anywhere in their cells.
        lattice = torch.round(in_cells - in_cells[self.volumes.argmax()]).long()
        blocks = torch.div(lattice - lattice.amin(0), factor, rounding_mode="floor")
        size = blocks.amax(0) + 1
        distinct, block = torch.unique(
            (blocks[:, 0] * size[1] + blocks[:, 1]) * size[2] + blocks[:, 2], return_inverse=True
        )
        volumes = self.volumes.double()
        # so that nodes without volume still have a defined centroid
        weights = volumes.clamp_min(1e-12 * volumes.max().clamp_min(1e-300))
        totals = torch.zeros(len(distinct), dtype=torch.float64, device=volumes.device).index_add(0, block, weights)
        moments = totals.new_zeros(len(distinct), 3).index_add(0, block, weights[:, None] * self.points.double())
        merged = torch.zeros_like(totals).index_add(0, block, volumes)
        return ImplantPointCloud(*(t.to(self.points) for t in (moments / totals[:, None], merged, self.cell * factor)))

    def principal_axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centre of mass (3,), principal axes (3, 3) in rows and extents (3,) of the nodes along them, in mm.

        Axes are ordered from the smallest to the largest variance: the third one runs along a plate. The largest
        component of the second and the third axis is positive; the sign of the first axis makes them a proper rotation.
        """
        points, volumes = self.points.double(), self.volumes.double()
        share = (volumes / volumes.sum())[:, None]
        center = (share * points).sum(0)
        centred = points - center
        _, vectors = torch.linalg.eigh((share * centred).mT @ centred)
        axes = vectors.mT
        largest = (axes.abs() > axes.abs().amax(1, keepdim=True) - 1e-6).long().argmax(1)  # the first of equal ones
        axes = axes * axes.gather(1, largest[:, None]).sign()
        axes = torch.cat([torch.linalg.det(axes).sign() * axes[:1], axes[1:]])
        along = centred @ axes.mT
        extents = along.amax(0) - along.amin(0)
        return center.to(self.points), axes.to(self.points), extents.to(self.points)

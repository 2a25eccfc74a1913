"""Images at the resolution of a stage, cropped to the implants, and the nodes rendered on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.projector import Footprint, cell_footprint, project_points

from .assembly import Assembly
from .data import RegistrationData
from .following import FollowingBackground, resized
from .state import Placement


@dataclass(frozen=True)
class _Body:
    """Nodes of one material in one assembly: the implant's, if made of it, then those of components."""

    material: int
    assembly: int
    holds_implant: bool
    components: list[tuple[int, Tensor]]  # index in the assembly, nodes in the implant's frame
    volumes: Tensor
    footprint: Footprint

    def points(self, placements: Sequence[Placement]) -> Tensor:
        """World positions (K, N, 3) of the nodes."""
        return _points(placements[self.assembly], self.holds_implant, self.components)


class View:
    """Pixels on which a scene is rendered and compared, and the nodes that are rendered.

    Args:
        assemblies: Assemblies near the states that will be rendered.
        materials: Names in the order of the path lengths.
        data: Measured images, or a geometry alone.
        bin: Detector pixels are averaged in squares of this side.
        oversampling: Path lengths are rendered on pixels this many times finer and averaged as intensities: the mean of
            exponentials is not the exponential of the mean.
        pitch_factor: The implants' nodes are merged on a lattice this many times coarser.
        margin_mm: Margin around the implants' projection, mm at the detector; None: the whole detector.
        backend: Projector.

    Attributes:
        data: The images at this scale; None for a geometry alone.
        geometry: The views at this scale.
        fine: The views with the finer pixels that are rendered.
        pixel_px: Edge of a rendered pixel in detector pixels.
        nodes: Rendered nodes (N, 3) of each assembly, in its implant's frame.
    """

    def __init__(
        self,
        assemblies: Sequence[Assembly],
        materials: Sequence[str],
        data: RegistrationData | ConeBeamGeometry,
        *,
        bin: int = 1,
        oversampling: int = 2,
        pitch_factor: int = 1,
        margin_mm: float | None = None,
        backend: str = "auto",
    ) -> None:
        self.oversampling, self.backend = oversampling, backend
        self.pixel_px = bin / oversampling
        self.data = data.binned(bin) if isinstance(data, RegistrationData) else None
        self.geometry = data.bin(bin) if isinstance(data, ConeBeamGeometry) else data.geometry.bin(bin)
        self.dtype = torch.float32 if self.data is None else self.data.line_integrals.dtype
        clouds = [_coarsened(a.implant, pitch_factor) for a in assemblies]
        self.nodes = [cloud.points.to(self.dtype) for cloud in clouds]
        with torch.no_grad():
            placements = [a.placement(nodes) for a, nodes in zip(assemblies, self.nodes, strict=True)]
        parts = [[_coarsened(c.cloud, pitch_factor) for c in a.components] for a in assemblies]
        if margin_mm is not None and self.data is not None:
            seen = [placed.nodes[0] for placed in placements]
            seen += [
                transform_points(motion, cloud.points.double()).to(self.dtype)
                for placed, clouds_of_parts in zip(placements, parts, strict=True)
                for motion, cloud in zip(placed.components[0], clouds_of_parts, strict=True)
            ]
            self.data = self.data.windowed(torch.cat(seen), margin_mm / self.geometry.pixel_spacing[1])
            self.geometry = self.data.geometry
        self.fine = self.geometry.refined(oversampling)
        self.matrices = self.fine.projection_matrices.to(self.dtype)
        self.bodies = [
            body
            for number, assembly in enumerate(assemblies)
            for index, name in enumerate(materials)
            if (body := self._body(index, name, number, assembly, clouds[number], parts[number], placements[number]))
        ]
        self.background = None if self.data is None else self.data.background
        if self.background is not None:
            self.background = resized(self.background, self.fine.det_shape)
        self.following = self._following()

    def _body(
        self,
        index: int,
        material: str,
        number: int,
        assembly: Assembly,
        cloud: ImplantPointCloud,
        parts: Sequence[ImplantPointCloud],
        placed: Placement,
    ) -> _Body | None:
        holds_implant = assembly.material == material
        members = [j for j, component in enumerate(assembly.components) if component.material == material]
        if not holds_implant and not members:
            return None
        volumes = torch.cat([c.volumes for c in [*([cloud] if holds_implant else []), *(parts[j] for j in members)]])
        nodes = [(j, parts[j].points.to(self.dtype)) for j in members]
        cell = cloud.cell.to(self.dtype) @ assembly.implant_to_world.detach()[:3, :3].to(self.dtype).T
        footprint = cell_footprint(_points(placed, holds_implant, nodes)[0], cell, self.matrices)
        return _Body(index, number, holds_implant, nodes, volumes.to(self.dtype), footprint)

    def _following(self) -> FollowingBackground | None:
        data = self.data
        if data is None or self.background is None or not data.background_mm > 0:
            return None
        sigma = data.background_mm / self.geometry.pixel_spacing[1]
        return FollowingBackground(data.line_integrals, data.mask, data.scatter_shapes, sigma)

    @property
    def images(self) -> RegistrationData:
        """The measured images.

        Raises:
            ValueError: If the view has only a geometry.
        """
        if self.data is None:
            raise ValueError("the view has a geometry alone, and no measured images to compare with")
        return self.data

    @property
    def num_nodes(self) -> int:
        """Number of nodes of all materials."""
        return sum(len(body.volumes) for body in self.bodies)

    def path_lengths(
        self, placements: Sequence[Placement], num_materials: int, views: Tensor | None = None
    ) -> list[Tensor]:
        """Path lengths (K, V, rows, cols) of each material on the rendered pixels, mm.

        Args:
            placements: Placement of each assembly, for K candidates.
            num_materials: Number of materials.
            views: Motions (K, V, 4, 4) of the world before it is projected in each view.
        """
        shape = (len(placements[0].nodes), len(self.matrices), *self.fine.det_shape)
        paths = [self.matrices.new_zeros(()).expand(shape) for _ in range(num_materials)]
        for body in self.bodies:
            drawn = self._drawn(body, body.points(placements), views)
            first = all(other is body or other.material != body.material for other in self.bodies)
            paths[body.material] = drawn if first else paths[body.material] + drawn
        return paths

    def _drawn(self, body: _Body, points: Tensor, views: Tensor | None) -> Tensor:
        """Path lengths (K, V, rows, cols) of a body at points (K, N, 3)."""
        if views is None:
            return self._projected(body, points, slice(None))
        if not views.requires_grad and bool((views == views[:1]).all()):  # the same for all candidates
            return self._projected(body, points, slice(None), self.matrices @ views[0].to(self.matrices))
        alone = [  # motions that differ between views are projected view by view
            self._projected(body, transform_points(motion.to(points), points), slice(view, view + 1))
            for view, motion in enumerate(views.unbind(1))
        ]
        return torch.cat(alone, dim=1)

    def _projected(self, body: _Body, points: Tensor, views: slice, matrices: Tensor | None = None) -> Tensor:
        footprint = Footprint(body.footprint.table[views], body.footprint.block_size)
        matrices, shape = self.matrices[views] if matrices is None else matrices, self.fine.det_shape
        return project_points(points, body.volumes, matrices, shape, footprint=footprint, backend=self.backend)

    def cloud_path_lengths(self, cloud: ImplantPointCloud, motion: Tensor) -> Tensor:
        """Path lengths (V, rows, cols) in mm of a cloud, moved by (4, 4) into the world, on the rendered pixels."""
        points = transform_points(motion, cloud.points.to(motion)).to(self.dtype)
        cell = (cloud.cell.to(motion) @ motion[:3, :3].T).to(self.dtype)
        volumes = cloud.volumes.to(points)
        return project_points(points, volumes, self.matrices, self.fine.det_shape, cell=cell, backend=self.backend)


def _points(placed: Placement, holds_implant: bool, components: Sequence[tuple[int, Tensor]]) -> Tensor:
    parts = [placed.nodes] if holds_implant else []
    parts += [transform_points(placed.components[:, j].to(nodes), nodes) for j, nodes in components]
    return torch.cat(parts, dim=1)


def _coarsened(cloud: ImplantPointCloud, factor: int) -> ImplantPointCloud:
    return cloud if factor == 1 else cloud.coarsened(factor)

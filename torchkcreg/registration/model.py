"""The DRRs of a stage as a function of the motions of control-point groups."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchkcreg.deformation import cluster_control_points, control_point_masses, group_centers, group_moments
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.projector import cell_footprint, project_points

from .config import RegistrationConfig, Stage
from .data import RegistrationData, resized
from .elasticity import Elasticity, ModalMotion
from .following import FollowingBackground
from .found_screw import FoundScrew, ScrewShapes
from .motion import GroupMotion
from .nuisance import Nuisance
from .scene import Scene
from .tilts import ComponentTilts

_SCREW_PITCH_MM = 0.5
_SOLID_PITCH_FACTOR = 8  # bending is smooth: its energy needs few nodes


@dataclass(frozen=True)
class _MaterialCloud:
    """Nodes of one material: the implant's own, if it is of it, then those of components."""

    material: int  # index in the scene
    holds_implant: bool
    components: list[tuple[int, Tensor]]  # index in the scene, nodes in the implant's frame
    masses: Tensor


class Blocks(NamedTuple):
    """Parameters of the motion, of the intensity model, of the shapes of found screws and of components' tilts."""

    motion: Tensor
    physics: Tensor
    shapes: Tensor
    tilts: Tensor


@dataclass(frozen=True)
class _Displaced:
    """World positions (N, 3) of points at rest, and the moments (N, 4 G) by which the groups displace them."""

    world: Tensor
    moments: Tensor

    def __call__(self, coefficients: Tensor) -> Tensor:
        """World positions (K, N, 3) for motions (K, 4 G, 3) of the groups."""
        return self.world + self.moments @ coefficients.to(self.moments)


class StageModel:
    """DRRs of whole batches of candidates at a stage's image scale.

    Parameters are increments in mm to the scene's state when the model is made: six a group or one an elastic mode,
    then those of the intensity model, of found screws and of components' tilts, see `Blocks`. Node weights are computed
    here, once: the displacement of a node is linear in the groups' motions, ``u = sum_g W_g t_g + (R_g - I) M_g``.

    Args:
        scene: Implant, components and intensity model in their present state.
        data: Projections at full resolution.
        stage: Groups, image scale, nodes.
        config: Projector backend.

    Raises:
        ValueError: If the stage has fewer groups than the scene: they could not hold its bending.
    """

    def __init__(self, scene: Scene, data: RegistrationData, stage: Stage, config: RegistrationConfig) -> None:
        if stage.groups < scene.num_groups:
            raise ValueError(
                f"a stage of {stage.groups} groups cannot follow one of {scene.num_groups}: groups only split"
            )
        self.scene, self.stage, self.config = scene, stage, config
        self.implant = _coarsened(scene.implant, stage.pitch_factor)
        self.screws: ScrewShapes | None = None
        self._screw_motions: dict[tuple[float, float, float], Tensor] = {}
        self._prepare_motion()
        self._prepare_clouds()
        self._prepare_images(data)
        self.nuisance = Nuisance(scene, config, stage.estimate, self.bin / stage.oversampling)
        if scene.found and stage.screws is not None:
            self.screws = ScrewShapes(scene.found, self.screw_path)
        self.tilts = ComponentTilts(scene) if scene.components and stage.tilts else None
        blocks = (self.motion, self.nuisance, self.screws, self.tilts)
        self._sizes = [0 if block is None else block.num_parameters for block in blocks]
        self.num_parameters = sum(self._sizes)

    def _prepare_motion(self) -> None:
        grid = self.scene.deformation.grid
        coarse = self.scene.implant.coarsened(4)
        self.weights = control_point_masses(grid, coarse.points, coarse.masses)
        self.labels = cluster_control_points(grid, self.weights, self.stage.groups)
        so_far = self.scene.deformation.control_points.detach().double().reshape(-1, 3)
        groups = GroupMotion(
            grid.positions().double().reshape(-1, 3),
            so_far if self.stage.modes is None else torch.zeros_like(so_far),
            self.labels.flatten(),
            self.weights.flatten(),
            group_centers(grid, self.labels),
        )
        solid = self.implant.coarsened(max(1, _SOLID_PITCH_FACTOR // self.stage.pitch_factor))
        self.elasticity = Elasticity(grid, self.labels, solid.points, solid.masses)
        self.motion: GroupMotion | ModalMotion = groups
        if self.stage.modes is not None:
            moved = self.scene.deformation.displacement(solid.points.double()) @ grid.frame[:3, :3].double()
            self.motion = ModalMotion(groups, self.elasticity, self.stage.modes, moved)
        self.grid_to_world = self.scene.implant_to_world @ grid.frame.to(self.scene.implant_to_world)
        self.nodes = self._displaced(self.implant.points, torch.float32)
        self.followed = [self._displaced(points, torch.float64) for points in self.scene.followed]

    def _displaced(self, points: Tensor, dtype: torch.dtype) -> _Displaced:
        shares, moments = group_moments(self.scene.deformation.grid, self.labels, points.double())
        world = transform_points(self.scene.implant_to_world, points.double())
        return _Displaced(world.to(dtype), torch.cat([shares[..., None], moments], dim=-1).flatten(1).to(dtype))

    def _prepare_clouds(self) -> None:
        self.clouds = []
        for index, material in enumerate(self.scene.materials):
            members = [(i, c) for i, c in enumerate(self.scene.components) if c.material == material]
            clouds = [_coarsened(c.cloud, self.stage.pitch_factor) for _, c in members]
            own = [self.implant] if material == self.scene.material else []
            if not own and not clouds:
                continue
            masses = torch.cat([cloud.masses for cloud in [*own, *clouds]]).float()
            nodes = [(i, cloud.points.float()) for (i, _), cloud in zip(members, clouds, strict=True)]
            self.clouds.append(_MaterialCloud(index, bool(own), nodes, masses))

    def _prepare_images(self, data: RegistrationData) -> None:
        stage = self.stage
        still = torch.zeros(1, self.motion.num_parameters, dtype=torch.float64)
        self._tilts_so_far = rotation_about(self.scene.heads, self.scene.tilts)[None]
        at_start = self._points(self.motion.steps(still), self._tilts_so_far)
        self.bin = stage.binning(data.geometry.pixel_spacing[1])
        self.data = data.binned(self.bin)
        if stage.margin_mm is not None:
            margin_px = stage.margin_mm / self.data.geometry.pixel_spacing[1]
            self.data = self.data.windowed(torch.cat([points[0] for points in at_start]), margin_px)
        fine = self.data.geometry.refined(stage.oversampling)
        self.matrices, self.det_shape = fine.projection_matrices.float(), fine.det_shape
        behind = self.data.background
        self.background, self.following = None, None
        if behind is not None and self.scene.is_polyenergetic:
            self.background = resized(behind, fine.det_shape)
        if self.background is not None and self.data.background_mm > 0:
            sigma = self.data.background_mm / self.data.geometry.pixel_spacing[1]
            measured, shapes = self.data.line_integrals, self.data.scatter_shapes
            self.following = FollowingBackground(measured, self.data.mask, shapes, sigma)
        cell = self.implant.cell.float() @ self.scene.implant_to_world[:3, :3].float().T
        self.footprints = [cell_footprint(points[0], cell, self.matrices) for points in at_start]

    @property
    def num_nodes(self) -> int:
        """Nodes of all materials."""
        return sum(len(cloud.masses) for cloud in self.clouds)

    @property
    def at_rest(self) -> Tensor:
        """The candidate (1, D) that leaves the scene as it is."""
        return torch.zeros(1, self.num_parameters, dtype=torch.float64)

    def split(self, parameters: Tensor) -> Blocks:
        """Parameters (..., D), block by block."""
        return Blocks(*parameters.split(self._sizes, dim=-1))

    def clamped(self, parameters: Tensor) -> Tensor:
        """Parameters (K, D), all within their bounds."""
        motion, physics, shapes, tilts = self.split(parameters)
        if self.screws:
            shapes = self.screws.clamp(shapes)
        return torch.cat([motion, self.nuisance.clamp(physics), shapes, tilts], dim=-1)

    def motion_steps(self, parameters: Tensor) -> Tensor:
        """Motions (K, 4 G, 3) of the groups in the grid's axes, as the moments multiply them: t_g, then R_g - I."""
        return self.motion.steps(parameters[..., : self.motion.num_parameters])

    def world_points(self, parameters: Tensor) -> list[Tensor]:
        """World positions (K, N_m, 3) of the nodes of each material."""
        tilts = self.tilts.motions(self.split(parameters).tilts) if self.tilts else self._tilts_so_far
        return self._points(self.motion_steps(parameters), tilts)

    def _points(self, steps: Tensor, tilts: Tensor) -> list[Tensor]:
        steps = steps @ self.grid_to_world[:3, :3].T
        motions = [
            fit_rigid(points.double().expand(len(steps), -1, -1), displaced(steps))
            for points, displaced in zip(self.scene.followed, self.followed, strict=True)
        ]
        motions = [motion @ tilts[:, index] for index, motion in enumerate(motions)]
        clouds = []
        for cloud in self.clouds:
            parts = [self.nodes(steps)] if cloud.holds_implant else []
            parts += [transform_points(motions[i].float(), nodes) for i, nodes in cloud.components]
            clouds.append(torch.cat(parts, dim=1))
        return clouds

    def path_lengths(self, parameters: Tensor) -> Tensor:
        """Path lengths (K, M, V, rows, cols) of candidates (K, D) on the oversampled pixels, mm.

        Where the intensity model knows one, the last of the materials is the background.
        """
        materials = self.scene.materials
        shape = (len(parameters), len(self.matrices), *self.det_shape)
        paths = [torch.zeros(()).expand(shape) for _ in materials]
        for points, cloud, footprint in zip(self.world_points(parameters), self.clouds, self.footprints, strict=True):
            paths[cloud.material] = project_points(
                points, cloud.masses, self.matrices, self.det_shape, footprint=footprint, backend=self.config.backend
            )
        if self.screws:
            for name, added in self.screws(self.split(parameters).shapes).items():
                paths[materials.index(name)] = paths[materials.index(name)] + added
        if self.scene.is_polyenergetic:
            unknown = torch.zeros(()) if self.background is None else self.background
            paths.append(unknown.expand(shape))
        return torch.stack(paths, dim=-4)

    @torch.no_grad()
    def screw_path(self, screw: FoundScrew) -> Tensor:
        """Path lengths (V, rows, cols) in mm of a screw where the scene has it."""
        if screw.start not in self._screw_motions:
            self._screw_motions[screw.start] = self.scene.implant_to_world @ self.scene.motion_at(screw.start)
        motion, cloud = self._screw_motions[screw.start], screw.cloud(_SCREW_PITCH_MM)
        points = transform_points(motion, cloud.points).float()
        footprint = cell_footprint(points, (cloud.cell @ motion[:3, :3].T).float(), self.matrices)
        masses, backend = cloud.masses.float(), self.config.backend
        return project_points(points, masses, self.matrices, self.det_shape, footprint=footprint, backend=backend)

    def intensity_options(self, parameters: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of the intensity model for candidates (K, D)."""
        options = self.nuisance(self.split(parameters).physics)
        if self.data.scatter_shapes is not None and self.scene.is_polyenergetic:
            options["scatter_shapes"] = self.data.scatter_shapes
        return options

    def line_integrals(self, parameters: Tensor) -> Tensor:
        """DRRs (K, V, rows, cols) of candidates (K, D), with the background that goes with each."""
        paths, options = self.path_lengths(parameters), self.intensity_options(parameters)
        lines = self.scene.intensity(paths, pooling=self.stage.oversampling, **options)
        if self.following is None:
            return lines
        levels = torch.stack([options["scatter"], options["scatter_removed"]], dim=-1)
        return self.following(lines, levels)


def _coarsened(cloud: ImplantPointCloud, factor: int) -> ImplantPointCloud:
    return cloud if factor == 1 else cloud.coarsened(factor)

"""The objective of a stage: -GC + beta R as a function of the motions of control-point groups (section 2.3 of the paper)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation import (
    cluster_control_points,
    control_point_masses,
    control_points_from_groups,
    diffusion_penalty,
    group_centers,
    group_moment_gradients,
    group_moments,
    strain_energy,
)
from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.projector import cell_footprint, project_points
from torchkcreg.similarity import GradientCorrelation

from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .motion import GroupMotion
from .nuisance import Nuisance
from .scene import Scene


class StageObjective:
    """Losses, gradients and curvature of one stage, for whole batches of candidates.

    Parameters are increments in mm to the scene's state at the start of the stage: six a group, then the estimated
    parameters of the intensity model. Node weights are computed here, once: the displacement of a node is linear in
    the groups' motions, ``u = sum_g W_g t_g + (R_g - I) M_g``.

    Args:
        scene: Implant, components and intensity model in their present state.
        data: Projections at full resolution.
        stage: Groups, image scale, nodes.
        config: Penalty weights, margins, backend.
    """

    def __init__(self, scene: Scene, data: RegistrationData, stage: Stage, config: RegistrationConfig) -> None:
        self.scene, self.stage, self.config = scene, stage, config
        grid = scene.deformation.grid
        implant = scene.implant if stage.pitch_factor == 1 else scene.implant.coarsened(stage.pitch_factor)
        self.to_world = scene.implant_to_world @ grid.frame.to(scene.implant_to_world)
        self.weights = control_point_masses(grid, scene.implant.coarsened(4).points, scene.implant.coarsened(4).masses)
        self.labels = cluster_control_points(grid, self.weights, stage.groups)
        self._prepare_motion(implant)
        self._prepare_images(implant, data)
        self.nuisance = Nuisance(scene.intensity, stage.estimate, stage.bin / stage.oversampling)
        self.num_parameters = self.motion.num_parameters + self.nuisance.num_parameters

    # -- set-up ----------------------------------------------------------------------------------------------------

    def _prepare_motion(self, implant) -> None:
        grid = self.scene.deformation.grid
        phi = self.scene.deformation.control_points.detach().double()
        positions = grid.positions().double()
        centers = group_centers(grid, self.labels)
        self.motion = GroupMotion(
            positions.reshape(-1, 3), phi.reshape(-1, 3), self.labels.flatten(), self.weights.flatten(), centers
        )
        self.nodes = self._features(implant.points)
        self.solid = implant.coarsened(max(1, 8 // self.stage.pitch_factor))
        self.slopes = group_moment_gradients(grid, self.labels, self.solid.points.double()).flatten(-2)
        self.followed = [self._features(points, torch.float64) for points in self.scene.followed]

    def _features(self, points: Tensor, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
        """World positions (N, 3) of undisplaced points and the moments (N, 4 G) that displace them."""
        grid = self.scene.deformation.grid
        shares, moments = group_moments(grid, self.labels, points.double(), num_groups=self.stage.groups)
        world = transform_points(self.scene.implant_to_world, points.double())
        return world.to(dtype), torch.cat([shares[..., None], moments], dim=-1).flatten(1).to(dtype)

    def _prepare_images(self, implant, data: RegistrationData) -> None:
        start, stage = torch.zeros(1, self.motion.num_parameters, dtype=torch.float64), self.stage
        self.clouds = []  # per material: does it hold the implant, which components, masses
        for material in self.scene.materials:
            members = [i for i, c in enumerate(self.scene.components) if c.material == material]
            own = [self._component_cloud(i) for i in members]
            holds_implant = material == self.scene.material
            masses = torch.cat([*([implant.masses] if holds_implant else []), *(c.masses for c in own)])
            self.clouds.append((holds_implant, members, [c.points for c in own], masses.float()))
        spacing = data.geometry.pixel_spacing[1] * stage.bin
        self.data, points = data.binned(stage.bin), self.world_points(start)
        if stage.margin_mm is not None:
            self.data = self.data.windowed(torch.cat([p[0] for p in points]), stage.margin_mm / spacing)
        fine = self.data.geometry.refined(stage.oversampling)
        self.matrices, self.det_shape = fine.projection_matrices.float(), fine.det_shape
        self.similarity = GradientCorrelation(self.data.line_integrals, self.data.mask)
        rotation = self.scene.implant_to_world[:3, :3].float()
        cell = implant.cell.float() @ rotation.T
        self.footprints = [cell_footprint(p[0], cell, self.matrices) for p in points]

    def _component_cloud(self, index: int):
        cloud = self.scene.components[index].cloud
        return cloud if self.stage.pitch_factor == 1 else cloud.coarsened(self.stage.pitch_factor)

    # -- the model -------------------------------------------------------------------------------------------------

    def world_points(self, parameters: Tensor) -> list[Tensor]:
        """World positions (K, N_m, 3) of the nodes of each material."""
        rotations, translations = self.motion(parameters[:, : self.motion.num_parameters])
        turn = self.to_world[:3, :3]
        steps = torch.cat([translations[..., None, :], (rotations - torch.eye(3).to(rotations)).mT], dim=-2)
        coefficients = (steps @ turn.T).flatten(1, 2)  # (K, 4 G, 3), grid frame -> world
        motions = [self._follow(i, coefficients) for i in range(len(self.followed))]
        clouds = []
        for holds_implant, members, component_points, _ in self.clouds:
            parts = [self._displace(self.nodes, coefficients)] if holds_implant else []
            for index, points in zip(members, component_points, strict=True):
                parts.append(transform_points(motions[index].float(), points.float()))
            clouds.append(torch.cat(parts, dim=1))
        return clouds

    @staticmethod
    def _displace(features: tuple[Tensor, Tensor], coefficients: Tensor) -> Tensor:
        world, moments = features
        return world + moments @ coefficients.to(moments)

    def _follow(self, index: int, coefficients: Tensor) -> Tensor:
        """Implant frame to world (K, 4, 4) of a component: the rigid fit of the nodes near its head."""
        moved = self._displace(self.followed[index], coefficients)
        return fit_rigid(self.scene.followed[index].double().expand_as(moved), moved)

    def path_lengths(self, parameters: Tensor) -> Tensor:
        """Path lengths (K, M, V, rows, cols) of candidates (K, D) on the oversampled pixels, mm."""
        paths = [
            project_points(
                points, cloud[3], self.matrices, self.det_shape, footprint=footprint, backend=self.config.backend
            )
            for points, cloud, footprint in zip(self.world_points(parameters), self.clouds, self.footprints, strict=True)
        ]
        return torch.stack(paths, dim=-4)

    def line_integrals(self, parameters: Tensor) -> Tensor:
        """DRRs (K, V, rows, cols) of candidates (K, D)."""
        physics = self.nuisance(parameters[:, self.motion.num_parameters :])
        if self.data.background is not None:
            physics["background"] = self.data.background
        return self.scene.intensity(self.path_lengths(parameters), pooling=self.stage.oversampling, **physics)

    def control_points(self, parameters: Tensor) -> Tensor:
        """Control-point displacements (K, nx, ny, nz, 3) of candidates."""
        rotations, translations = self.motion(parameters[:, : self.motion.num_parameters])
        return control_points_from_groups(self.scene.deformation.grid, self.labels, rotations, translations)

    def deformation_gradients(self, parameters: Tensor) -> Tensor:
        """Deformation gradients (K, n, 3, 3) at some of the implant's nodes, in the grid's axes."""
        rotations, translations = self.motion(parameters[:, : self.motion.num_parameters])
        steps = torch.cat([translations[..., None, :], (rotations - torch.eye(3).to(rotations)).mT], dim=-2)
        return torch.eye(3).to(steps) + (self.slopes @ steps.flatten(1, 2)[:, None]).mT

    def penalty(self, parameters: Tensor) -> Tensor:
        """beta R (eq. 5) and the implant's elastic energy, weighted, of candidates, shape (K,)."""
        diffusion = diffusion_penalty(self.control_points(parameters), self.scene.deformation.grid)
        elastic = strain_energy(self.deformation_gradients(parameters), self.solid.masses)
        return self.config.beta * diffusion + self.config.stiffness * elastic

    # -- what optimisers ask for -----------------------------------------------------------------------------------

    def project(self, parameters: Tensor) -> Tensor:
        """Candidates with the intensity model's parameters inside their bounds."""
        motions, physics = parameters.split([self.motion.num_parameters, self.nuisance.num_parameters], dim=-1)
        return torch.cat([motions, self.nuisance.clamp(physics)], dim=-1)

    def gradient_correlations(self, parameters: Tensor) -> Tensor:
        """GC (K, V) of each candidate and view."""
        return self.similarity(self.line_integrals(parameters))

    @torch.no_grad()
    def losses(self, candidates: Tensor) -> Tensor:
        """1 - GC + beta R of candidates (K, D), shape (K,)."""
        chunks = [self._losses(c) for c in candidates.split(self._batch())]
        return torch.cat(chunks)

    def _losses(self, candidates: Tensor) -> Tensor:
        return 1 - self.gradient_correlations(candidates).double().mean(dim=-1) + self.penalty(candidates)

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and gradient (D,) at one vector."""
        leaf = parameters.detach().clone().requires_grad_(True)
        loss = self._losses(leaf[None])[0]
        (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient

    def curvature(self, parameters: Tensor, step_mm: float = 0.01) -> Tensor:
        """Gauss-Newton second derivatives (D, D): residual images differ by forward differences, R exactly."""
        offsets = step_mm * torch.eye(self.num_parameters, dtype=torch.float64)
        with torch.no_grad():
            center = self.similarity.residuals(self.line_integrals(parameters[None])).flatten(1)
            jacobian = torch.cat(
                [
                    (self.similarity.residuals(self.line_integrals(parameters + o)).flatten(1) - center) / step_mm
                    for o in offsets.split(self._batch())
                ]
            )
        data = 0.5 / self.data.num_views * (jacobian @ jacobian.T).double()
        penalty = torch.autograd.functional.hessian(lambda p: self.penalty(p[None])[0], parameters)
        return data + penalty

    def _batch(self) -> int:
        """Candidates that are rendered together: as many as 64 MB of node positions allow."""
        return max(1, int(5e6 / sum(len(c[3]) for c in self.clouds)))

    # -- results ---------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def accept(self, parameters: Tensor) -> None:
        """Moves the scene to ``parameters``; the best common rigid motion goes from phi into the global transform."""
        deformation = self.scene.deformation
        deformation.control_points.copy_(self.control_points(parameters[None])[0])
        deformation.labels.copy_(self.labels)
        common = deformation.remove_common_rigid(self.weights)
        self.scene.implant_to_world.copy_(self.scene.implant_to_world @ common.double())
        self.nuisance.accept(parameters[self.motion.num_parameters :])

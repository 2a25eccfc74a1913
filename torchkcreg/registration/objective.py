"""The objective of a stage: -GC + beta R and the implant's elastic energy (section 2.3 of the paper)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation import (
    control_points_from_groups,
    diffusion_penalty,
    group_moment_gradients,
    strain_energy,
)
from torchkcreg.similarity import GradientCorrelation

from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .model import StageModel
from .scene import Scene

_NODES_AT_ONCE = 5_000_000  # of all candidates that are rendered together: 60 MB of positions
_STRAIN_PITCH_FACTOR = 8  # bending is smooth: the energy needs few nodes


class StageObjective:
    """Losses, gradients and curvature of one stage, for whole batches of candidates.

    Args:
        scene: Implant, components and intensity model in their present state.
        data: Projections at full resolution.
        stage: Groups, image scale, nodes.
        config: Penalty weights, backend.
    """

    def __init__(self, scene: Scene, data: RegistrationData, stage: Stage, config: RegistrationConfig) -> None:
        self.scene, self.config = scene, config
        self.model = StageModel(scene, data, stage, config)
        self.num_parameters = self.model.num_parameters
        self.similarity = GradientCorrelation(self.model.data.line_integrals, self.model.data.mask)
        solid = self.model.implant.coarsened(max(1, _STRAIN_PITCH_FACTOR // stage.pitch_factor))
        self.volumes = solid.masses
        grid = scene.deformation.grid
        self.slopes = group_moment_gradients(grid, self.model.labels, solid.points.double()).flatten(-2)

    def control_points(self, parameters: Tensor) -> Tensor:
        """Control-point displacements (K, nx, ny, nz, 3) of candidates."""
        rotations, translations = self.model.motion(self.model.split(parameters)[0])
        return control_points_from_groups(self.scene.deformation.grid, self.model.labels, rotations, translations)

    def deformation_gradients(self, parameters: Tensor) -> Tensor:
        """Deformation gradients (K, n, 3, 3) at some of the implant's nodes, in the grid's axes."""
        steps = self.model.motion_steps(parameters)
        return torch.eye(3).to(steps) + (self.slopes @ steps[:, None]).mT

    def penalty(self, parameters: Tensor) -> Tensor:
        """beta R (eq. 5) and the implant's elastic energy, weighted, of candidates, shape (K,)."""
        diffusion = diffusion_penalty(self.control_points(parameters), self.scene.deformation.grid)
        elastic = strain_energy(self.deformation_gradients(parameters), self.volumes)
        return self.config.beta * diffusion + self.config.stiffness * elastic

    def project(self, parameters: Tensor) -> Tensor:
        """Candidates with the intensity model's parameters inside their bounds."""
        motion, physics = self.model.split(parameters)
        return torch.cat([motion, self.model.nuisance.clamp(physics)], dim=-1)

    def gradient_correlations(self, parameters: Tensor) -> Tensor:
        """GC (K, V) of each candidate and view."""
        return self.similarity(self.model.line_integrals(parameters))

    @torch.no_grad()
    def losses(self, candidates: Tensor) -> Tensor:
        """1 - GC + beta R of candidates (K, D), shape (K,)."""
        return torch.cat([self._losses(c) for c in candidates.split(self._batch())])

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
            center = self._residuals(parameters[None])
            jacobian = torch.cat([(self._residuals(parameters + o) - center) for o in offsets.split(self._batch())])
        data = 0.5 / self.model.data.num_views / step_mm**2 * (jacobian @ jacobian.T).double()
        penalty = torch.autograd.functional.hessian(lambda p: self.penalty(p[None])[0], parameters)
        return data + penalty

    def _residuals(self, candidates: Tensor) -> Tensor:
        return self.similarity.residuals(self.model.line_integrals(candidates)).flatten(1)

    def _batch(self) -> int:
        return max(1, _NODES_AT_ONCE // self.model.num_nodes)

    @torch.no_grad()
    def accept(self, parameters: Tensor) -> None:
        """Moves the scene to ``parameters``; the best common rigid motion goes from phi into the global transform."""
        deformation = self.scene.deformation
        deformation.control_points.copy_(self.control_points(parameters[None])[0])
        deformation.labels.copy_(self.model.labels)
        common = deformation.remove_common_rigid(self.model.weights)
        self.scene.implant_to_world.copy_(self.scene.implant_to_world @ common.double())
        self.model.nuisance.accept(self.model.split(parameters)[1])

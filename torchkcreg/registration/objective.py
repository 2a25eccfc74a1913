"""The objective of a stage: -GC + beta R (section 2.3 of the paper), and what is known of the implant's elasticity."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation import control_points_from_groups, diffusion_penalty
from torchkcreg.similarity import GradientCorrelation, GradientDifference, sobel_gradient

from .background import with_background
from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .elasticity import ModalMotion
from .model import StageModel
from .robust import residual_weights
from .scene import Scene

_BACKGROUND_PIXELS = 4.0  # a finer background takes over the edges that a stage sees
_NODES_AT_ONCE = 5_000_000  # of all candidates that are rendered together: 60 MB of positions


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
        self.measure = GradientDifference if stage.contrast and scene.is_polyenergetic else GradientCorrelation
        self.similarity = self.measure(self.model.data.line_integrals, self.model.data.mask)
        if stage.robust:
            self._reweight()

    def control_points(self, parameters: Tensor) -> Tensor:
        """Control-point displacements (K, nx, ny, nz, 3) of candidates."""
        rotations, translations = self.model.motion(self.model.split(parameters).motion)
        return control_points_from_groups(self.scene.deformation.grid, self.model.labels, rotations, translations)

    def penalty(self, parameters: Tensor) -> Tensor:
        """What speaks against candidates but the images, shape (K,).

        Groups: beta R (eq. 5) and the weighted elastic energy. Modes: the weighted sum of squared loads that hold the
        implant in its shape. Loads do not charge a bend for being strong, as the energy does, but for needing forces
        in many places: between the screws that load it a plate is free.
        """
        motion = self.model.motion
        blocks = self.model.split(parameters)
        unlikely = self.model.nuisance.penalty(blocks.physics)
        if self.model.tilts:
            unlikely = unlikely + self.model.tilts.penalty(blocks.tilts)
        physics = self.config.prior_weight * unlikely
        if isinstance(motion, ModalMotion):
            loads = self.config.youngs_modulus_gpa * motion.loads(blocks.motion)
            return physics + self.config.load_weight * loads.square().sum(-1)
        diffusion = diffusion_penalty(self.control_points(parameters), self.scene.deformation.grid)
        elastic = self.model.elasticity.energy(self.model.motion_steps(parameters))
        return physics + self.config.beta * diffusion + self.config.stiffness * elastic

    @torch.no_grad()
    def _reweight(self) -> None:
        model = self.model
        images = model.line_integrals(model.at_rest)
        residuals = self.similarity.residuals(images)[0]
        weights = residual_weights(residuals, sobel_gradient(images)[0], model.data.mask)
        self.similarity = self.measure(model.data.line_integrals, model.data.mask, weights)

    def project(self, parameters: Tensor) -> Tensor:
        """Candidates with the parameters of intensity model and screws inside their bounds."""
        return self.model.clamped(parameters)

    def similarities(self, parameters: Tensor) -> Tensor:
        """GD or GC (K, V) of each candidate and view."""
        return self.similarity(self.model.line_integrals(parameters))

    @torch.no_grad()
    def losses(self, candidates: Tensor) -> Tensor:
        """One less the similarity, and the penalties, of candidates (K, D), shape (K,)."""
        return torch.cat([self._losses(c) for c in candidates.split(self._batch())])

    def _losses(self, candidates: Tensor) -> Tensor:
        return 1 - self.similarities(candidates).double().mean(dim=-1) + self.penalty(candidates)

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and gradient (D,) at one vector."""
        leaf = parameters.detach().clone().requires_grad_(True)
        loss = self._losses(leaf[None])[0]
        (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient

    def curvature(self, parameters: Tensor, step_mm: float = 0.01) -> Tensor:
        """Gauss-Newton second derivatives (D, D): residual images differ by forward differences, R exactly."""
        return self.curvature_from(self.jacobian(parameters, step_mm)[0], parameters)

    def curvature_from(self, jacobian: Tensor, parameters: Tensor) -> Tensor:
        """Second derivatives (D, D) where the derivatives of the residuals are known."""
        flat = jacobian.flatten(1)
        penalty = torch.autograd.functional.hessian(lambda p: self.penalty(p[None])[0], parameters)
        return 0.5 / self.model.data.num_views * (flat @ flat.T).double() + penalty

    @torch.no_grad()
    def jacobian(self, parameters: Tensor, step_mm: float = 0.01) -> tuple[Tensor, Tensor]:
        """Derivatives (D, V, 2, rows, cols) of the residual images, and those (V, 2, rows, cols)."""
        offsets = step_mm * torch.eye(self.num_parameters, dtype=torch.float64)
        center = self._residuals(parameters[None])
        steps = [(self._residuals(parameters + o) - center) / step_mm for o in offsets.split(self._batch())]
        return torch.cat(steps), center[0]

    def _residuals(self, candidates: Tensor) -> Tensor:
        return self.similarity.residuals(self.model.line_integrals(candidates))

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
        blocks = self.model.split(parameters)
        self.model.nuisance.accept(blocks.physics)
        if self.model.tilts:
            self.scene.tilts = self.model.tilts.vectors(blocks.tilts).clone()
        if self.scene.found and (self.model.screws or self.model.tilts):
            screws = self.model.screws.stepped(blocks.shapes) if self.model.screws else self.scene.found
            shifts = self.model.tilts.shifts(blocks.tilts) if self.model.tilts else torch.zeros_like(self.scene.tilts)
            moved = [s.moved(*by) for s, *by in zip(screws, self.scene.tilts, shifts, strict=True)]
            self.scene.place(moved, self.config.pitch_mm)


def stage_objective(scene: Scene, data: RegistrationData, stage: Stage, config: RegistrationConfig) -> StageObjective:
    """The objective of a stage at the scene's present state, with the background that the stage asks for."""
    data = with_scatter_shapes(scene, data, config)
    if stage.background and scene.is_polyenergetic:
        pixel = data.geometry.pixel_spacing[1]
        width = max(config.background_mm, _BACKGROUND_PIXELS * stage.binning(pixel) * pixel)
        data = with_background(scene, data, config, width)
    return StageObjective(scene, data, stage, config)


def with_scatter_shapes(scene: Scene, data: RegistrationData, config: RegistrationConfig) -> RegistrationData:
    """The data with the shapes of the scatter, where the intensity model has scatter."""
    if not scene.is_polyenergetic or data.scatter_shapes is not None:
        return data
    return data.with_scatter_shapes(config.scatter_mm)

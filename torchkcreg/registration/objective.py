"""The objective of a stage: image similarity and penalties, with gradients, curvature and robust weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur
from torchkcreg.scene import Moves, Scene, State, View
from torchkcreg.similarity import Similarity, sobel_gradient

from .uncertainty import Uncertainty, views_a_side

_EDGE = 0.05  # a pixel lies on an edge of the model if its squared gradient has this share of the largest
_WINDOW_PX = 2.0
Penalty = Callable[[State], Tensor]
SimilarityFactory = Callable[[Tensor, Tensor | None, Tensor | None], Similarity]
_PROBES = 4  # random steps that compare changes of fine and coarse images
_NODES_AT_ONCE = 5_000_000  # of all candidates that are rendered together: 60 MB of positions


def residual_weights(residuals: Tensor, rendered: Tensor, valid: Tensor) -> Tensor:
    """Pixel weights (V, rows, cols): 1 where the model fits, towards 0 where it does not.

    `w = 1 / (1 + e / m)` with e the squared residual, averaged over a few pixels, and m its median over the edges of
    the rendered image: the weights of a Cauchy distribution for iteratively reweighted least squares (Holland & Welsch
    1977). The scale is the residual on the implant's own edges, so that a view in which the model fits badly
    everywhere keeps its weights.

    Args:
        residuals: Residuals of the unit gradients, shape (V, 2, rows, cols).
        rendered: Gradients of the rendered images, shape (V, 2, rows, cols).
        valid: True for valid pixels, shape (V, rows, cols).
    """
    valid = valid.to(residuals)
    energy = gaussian_blur(residuals.square().sum(1) * valid, _WINDOW_PX)
    edges = rendered.square().sum(1) * valid
    weights = torch.ones_like(energy)
    for view, (misfit, edge) in enumerate(zip(energy, edges, strict=True)):
        on_edge = edge > _EDGE * edge.max()
        if on_edge.any():
            weights[view] = 1 / (1 + misfit / misfit[on_edge].median().clamp_min(torch.finfo(misfit.dtype).tiny))
    return weights


class Objective:
    """Losses, gradients and curvature of a stage, for whole batches of candidates: -GC + beta R (section 2.3).

    Args:
        scene: Scene in its present state.
        view: View with measured images.
        moves: Parameters of the stage.
        similarity: Makes the data term from measured images, mask and weights.
        penalties: Further terms besides the parameters' priors: functions of K candidates to (K,).
        weights: Pixel weights, shape (V, rows, cols); uniform if None.
        coarse: The same objective on coarser pixels, for cheaper curvatures; this objective if None.

    Raises:
        ValueError: If the view has no measured images.
    """

    def __init__(
        self,
        scene: Scene,
        view: View,
        moves: Moves,
        similarity: SimilarityFactory,
        *,
        penalties: Sequence[Penalty] = (),
        weights: Tensor | None = None,
        coarse: Objective | None = None,
    ) -> None:
        self.scene, self.view, self.moves, self.penalties = scene, view, moves, list(penalties)
        self.coarse = coarse
        self.images = view.images
        self._make = similarity
        self.similarity = similarity(self.images.line_integrals, self.images.mask, weights)
        self.num_parameters = moves.num_parameters
        self.device = self.images.line_integrals.device

    @property
    def at_rest(self) -> Tensor:
        """The candidate (1, D) that leaves the scene unchanged."""
        return self.moves.at_rest(self.device)

    def project(self, parameters: Tensor) -> Tensor:
        """Candidates with all parameters clamped to their bounds."""
        return self.moves.clamp(parameters)

    def line_integrals(self, parameters: Tensor) -> Tensor:
        """DRRs (K, V, rows, cols) of candidates (K, D)."""
        return self.scene(self.view, self.moves.state(parameters))

    def similarities(self, parameters: Tensor) -> Tensor:
        """Similarity (K, V) of each candidate and view."""
        return self.similarity(self.line_integrals(parameters))

    def penalty(self, parameters: Tensor) -> Tensor:
        """Penalties and priors of candidates, shape (K,)."""
        return self._penalty(parameters, self.moves.state(parameters) if self.penalties else None)

    def _penalty(self, parameters: Tensor, state: State | None) -> Tensor:
        priors = self.moves.penalty(parameters)
        return priors if state is None else priors + sum(penalty(state) for penalty in self.penalties)

    @torch.no_grad()
    def losses(self, candidates: Tensor) -> Tensor:
        """1 minus the mean similarity, plus penalties, of candidates (K, D), shape (K,)."""
        return torch.cat([self._losses(c) for c in candidates.split(self._batch())])

    def _losses(self, candidates: Tensor) -> Tensor:
        state = self.moves.state(candidates)
        similarities = self.similarity(self.scene(self.view, state)).double()
        return 1 - similarities.mean(dim=-1) + self._penalty(candidates, state if self.penalties else None)

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and gradient (D,) at one vector."""
        leaf = parameters.detach().clone().requires_grad_(True)
        loss = self._losses(leaf[None])[0]
        (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient

    def curvature(self, parameters: Tensor, step_mm: float = 0.01) -> Tensor:
        """Gauss-Newton Hessian (D, D): residual images by forward differences, penalties exactly."""
        if self.coarse is None:
            return self.curvature_from(self.jacobian(parameters, step_mm)[0], parameters)
        jacobian, _ = self.coarse.jacobian(parameters, step_mm)
        return self.curvature_from(jacobian * self._sharper(jacobian, parameters, step_mm), parameters)

    @torch.no_grad()
    def _sharper(self, coarse: Tensor, parameters: Tensor, step_mm: float) -> float:
        """Ratio of changes of these images to those of coarse ones, whose derivatives (D, ...) are given.

        It is taken along random steps in which all parameters have equal effect.
        """
        signs = torch.randint(0, 2, (_PROBES, self.num_parameters), generator=torch.Generator().manual_seed(0)) * 2 - 1
        flat = coarse.flatten(1).double()
        steps = signs.to(flat) / flat.norm(dim=1).clamp_min(max(1e-9 * float(flat.norm()), 1e-30))
        steps = steps / steps.norm(dim=1, keepdim=True)
        center = self._residuals(parameters[None])
        fine = (self._residuals(parameters + step_mm * steps.to(parameters)) - center).flatten(1) / step_mm
        shown = float((steps @ flat).norm())
        return float(fine.norm()) / shown if shown > 0 else 1.0

    def curvature_from(self, jacobian: Tensor, parameters: Tensor) -> Tensor:
        """Gauss-Newton Hessian (D, D) from given derivatives of the residuals."""
        flat = jacobian.flatten(1)
        penalty = torch.autograd.functional.hessian(lambda p: self.penalty(p[None])[0], parameters, vectorize=True)
        return 0.5 / self.images.num_views * (flat @ flat.T).double() + penalty

    @torch.no_grad()
    def jacobian(self, parameters: Tensor, step_mm: float = 0.01) -> tuple[Tensor, Tensor]:
        """Derivatives (D, V, 2, rows, cols) of the residual images, and the residual images (V, 2, rows, cols)."""
        offsets = step_mm * torch.eye(self.num_parameters, dtype=parameters.dtype, device=parameters.device)
        center = self._residuals(parameters[None])
        view_parameters = self.moves.places.get("views")
        if view_parameters is None:
            return self._slopes(parameters, offsets, center, step_mm), center[0]
        # a view's motion changes only its own image, so all views are stepped at once
        views = self.images.num_views
        together = offsets[view_parameters].unflatten(0, (views, -1)).sum(0)
        derivatives = center.new_zeros(self.num_parameters, *center.shape[1:])
        derivatives[: view_parameters.start] = self._slopes(
            parameters, offsets[: view_parameters.start], center, step_mm
        )
        derivatives[view_parameters.stop :] = self._slopes(parameters, offsets[view_parameters.stop :], center, step_mm)
        of_views = self._slopes(parameters, together, center, step_mm)
        for view, block in enumerate(derivatives[view_parameters].unflatten(0, (views, -1))):
            block[:, view] = of_views[:, view]
        return derivatives, center[0]

    def _slopes(self, parameters: Tensor, offsets: Tensor, center: Tensor, step_mm: float) -> Tensor:
        """Difference quotients (K, V, ...) of the residual images (1, V, ...) for offsets (K, D)."""
        batches = offsets.split(self._batch()) if len(offsets) else ()
        return torch.cat([center[:0], *((self._residuals(parameters + o) - center) / step_mm for o in batches)])

    def uncertainty(self, parameters: Tensor) -> Uncertainty:
        """Uncertainty of parameters (D,) near the optimum."""
        return self.uncertainty_from(*self.jacobian(parameters), parameters)

    def uncertainty_from(self, jacobian: Tensor, residuals: Tensor, parameters: Tensor) -> Uncertainty:
        """Uncertainty from given derivatives of the residuals, see `jacobian`."""
        pixel = self.view.geometry.pixel_spacing[1]
        first = self.scene.assemblies[0].nodes()
        return Uncertainty.of(
            jacobian,
            residuals,
            self.moves,
            self.penalty,
            parameters,
            pixel_mm=pixel,
            views_a_side=views_a_side(self.images.geometry.source_positions.to(first), first),
            screws_found=any(assembly.found for assembly in self.scene),
        )

    def _residuals(self, candidates: Tensor) -> Tensor:
        return self.similarity.residuals(self.line_integrals(candidates))

    def _batch(self) -> int:
        return max(1, _NODES_AT_ONCE // self.view.num_nodes)

    @torch.no_grad()
    def reweighted(self) -> Objective:
        """The objective with pixels weighted by how well the scene explains them, see `residual_weights`."""
        images = self.line_integrals(self.at_rest)
        residuals = self.similarity.residuals(images)[0]
        weights = residual_weights(residuals, sobel_gradient(images)[0], self.images.mask)
        coarse = None if self.coarse is None else self.coarse.reweighted()
        return Objective(
            self.scene, self.view, self.moves, self._make, penalties=self.penalties, weights=weights, coarse=coarse
        )

    def accept(self, parameters: Tensor) -> None:
        """Move the scene to parameters (D,)."""
        self.moves.accept(parameters)

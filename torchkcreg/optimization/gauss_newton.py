"""Gauss-Newton with damped steps."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from .optimizer import Optimizer, Options, Problem

_HOLDS = 24  # how often the term that shortens a step may be tripled
_FIRM = 1e-2  # smallest damping after a rejected step
_NEGLIGIBLE = 2e-5  # share of the loss: a smaller predicted decrease ends the optimisation


class GaussNewton(Optimizer):
    """Gauss-Newton with Levenberg-Marquardt damping (Marquardt 1963) and steps of at most `stage.step_mm`.

    The gradient is exact. The curvature is computed once, updated with every accepted step (BFGS), and recomputed when
    steps no longer agree with it. The optimisation also ends after an accepted step whose predicted decrease of the
    loss is negligible: such steps only move, by micrometres, what the images hardly determine.
    """

    _KEPT: ClassVar[tuple[str, ...]] = ("_parameters", "_loss", "_gradient", "_curvature", "_fresh", "_damping")

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        super().__init__(problem, stage, seed)
        self._parameters = self._zeros()
        self._curvature: Tensor | None = None
        self._damping, self._fresh = 1e-3, True

    def ask(self) -> Tensor:
        """Candidate after the next step, as a batch of one."""
        if self._curvature is None:
            self._loss, self._gradient = self.problem.loss_and_gradient(self._parameters)
            self._curvature = self.problem.curvature(self._parameters)
        return self._within_bounds(self._curvature)[None]

    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """Accept the step if it lowers the loss, else shorten the next one."""
        if self._curvature is None:
            raise RuntimeError("call ask before tell")
        trial, trial_loss = candidates[0], float(losses[0])
        step = trial - self._parameters
        predicted = float(-(self._gradient @ step) - 0.5 * step @ self._curvature @ step)
        size = float(step.abs().max())
        gain = (self._loss - trial_loss) / max(predicted, 1e-16)
        taken = trial_loss < self._loss
        if taken:
            before = self._gradient
            self._parameters = trial
            self._loss, self._gradient = self.problem.loss_and_gradient(trial)
            self._curvature = learned(self._curvature, step, self._gradient - before)
            self._damping = max(self._damping / 5, 1e-6) if gain > 0.5 else self._damping * 2
            self._fresh = False
        else:
            self._damping = max(8 * self._damping, _FIRM)
        lost = self._fresh and self._damping > 1e6
        small = size < self.stage.tolerance or (taken and predicted < _NEGLIGIBLE * self._loss)
        self._advance(self._loss, size, end=small or lost)
        if not self.done and not self._fresh and gain < 0.25:
            self._curvature, self._fresh = self.problem.curvature(self._parameters), True

    def best(self) -> Tensor:
        """Current parameters."""
        return self._parameters

    def state_dict(self) -> dict[str, Any]:
        """Parameters, loss, gradient, curvature and damping, for a checkpoint. Empty before the first iteration."""
        if self._curvature is None:
            return {}
        return {**{name: getattr(self, name) for name in self._KEPT}, **self._ended()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a checkpoint."""
        if not state:
            return
        for name in self._KEPT:
            value = state[name]
            setattr(self, name, value.clone() if isinstance(value, Tensor) else value)
        self._end_as(state)

    def _within_bounds(self, curvature: Tensor) -> Tensor:
        """Parameters after a damped step within the bounds.

        If bounds cut the step, it is solved again for the other parameters with the bounded ones fixed.
        """
        here, gradient = self._parameters, self._gradient
        unbounded = here + self._damped_step(curvature, gradient)
        trial = self.problem.project(unbounded[None])[0]
        free = trial == unbounded
        if free.all() or not free.any():
            return trial
        held = (trial - here)[~free]
        rest = gradient[free] + curvature[free][:, ~free] @ held
        trial[free] = here[free] + self._damped_step(curvature[free][:, free], rest)
        return self.problem.project(trial[None])[0]

    def _damped_step(self, curvature: Tensor, gradient: Tensor) -> Tensor:
        """Levenberg-Marquardt step, shortened until no parameter moves by more than `stage.step_mm`.

        The term added to the diagonal is the same for all parameters, since all are scaled to millimetres. So it first
        shortens steps of parameters that the images hardly determine, and not those of the others.
        """
        diagonal = curvature.diagonal()
        shortening = 1e-6 * float(diagonal.mean())
        for _ in range(_HOLDS):
            step = -torch.linalg.solve(curvature + torch.diag(self._damping * diagonal + shortening), gradient)
            if float(step.abs().max()) <= self.stage.step_mm:
                break
            shortening *= 3
        return step * min(1.0, self.stage.step_mm / max(float(step.abs().max()), 1e-12))


def learned(curvature: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """BFGS update of the curvature (D, D) from the change of the gradient along a step.

    Powell's damping (1978) keeps it positive definite where the gradient decreases along the step.
    """
    along = curvature @ step
    expected, seen = float(step @ along), float(step @ change)
    if not expected > 0:
        return curvature
    share = 1.0 if seen >= 0.2 * expected else 0.8 * expected / (expected - seen)
    change = share * change + (1 - share) * along
    return curvature - torch.outer(along, along) / expected + torch.outer(change, change) / float(step @ change)

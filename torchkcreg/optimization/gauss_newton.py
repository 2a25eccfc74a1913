"""Gauss-Newton, a damped step at a time."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from .optimizer import Optimizer, Options, Problem

_HOLDS = 24  # how often what holds a step may be tripled
_FIRM = 1e-2  # the least damping after a step that led up
_NEGLIGIBLE = 2e-5  # of the loss


class GaussNewton(Optimizer):
    """Gauss-Newton with Levenberg-Marquardt damping (Marquardt 1963) and steps of at most ``stage.step_mm``.

    The gradient is exact; the curvature is taken once, learns from every step that is taken, and is taken again when
    steps stop agreeing with it. It also ends with a step that is taken and promised next to nothing: it moved what the
    images hardly show by micrometres.
    """

    _KEPT: ClassVar[tuple[str, ...]] = ("_parameters", "_loss", "_gradient", "_curvature", "_fresh", "_damping")

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        super().__init__(problem, stage, seed)
        self._parameters = self._zeros()
        self._curvature: Tensor | None = None
        self._damping, self._fresh = 1e-3, True

    def ask(self) -> Tensor:
        """Where the next step leads."""
        if self._curvature is None:
            self._loss, self._gradient = self.problem.loss_and_gradient(self._parameters)
            self._curvature = self.problem.curvature(self._parameters)
        return self._within_bounds(self._curvature)[None]

    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """The step is taken if it leads down; else the next one is shorter."""
        if self._curvature is None:
            raise RuntimeError("ask comes before tell")
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
        """Where it is."""
        return self._parameters

    def state_dict(self) -> dict[str, Any]:
        """Parameters, what is known of the loss there, and damping; nothing before the first iteration."""
        if self._curvature is None:
            return {}
        return {**{name: getattr(self, name) for name in self._KEPT}, **self._ended()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """All of them."""
        if not state:
            return
        for name in self._KEPT:
            value = state[name]
            setattr(self, name, value.clone() if isinstance(value, Tensor) else value)
        self._end_as(state)

    def _within_bounds(self, curvature: Tensor) -> Tensor:
        """Where a damped step leads inside the bounds; the free parameters know which ones a bound holds back."""
        here, gradient = self._parameters, self._gradient
        wanted = here + self._damped_step(curvature, gradient)
        trial = self.problem.project(wanted[None])[0]
        free = trial == wanted
        if free.all() or not free.any():
            return trial
        held = (trial - here)[~free]
        rest = gradient[free] + curvature[free][:, ~free] @ held
        trial[free] = here[free] + self._damped_step(curvature[free][:, free], rest)
        return self.problem.project(trial[None])[0]

    def _damped_step(self, curvature: Tensor, gradient: Tensor) -> Tensor:
        """The Levenberg-Marquardt step, held until no parameter moves by more than ``stage.step_mm``.

        What holds it is the same for all parameters, which are all worth millimetres: those that the images hardly show
        are held first, and do not shorten the others' steps.
        """
        diagonal = curvature.diagonal()
        held = 1e-6 * float(diagonal.mean())
        for _ in range(_HOLDS):
            step = -torch.linalg.solve(curvature + torch.diag(self._damping * diagonal + held), gradient)
            if float(step.abs().max()) <= self.stage.step_mm:
                break
            held *= 3
        return step * min(1.0, self.stage.step_mm / max(float(step.abs().max()), 1e-12))


def learned(curvature: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """The curvature (D, D) with what a step taught of it, by how the gradient changed along it (BFGS).

    Powell's damping (1978) keeps it positive where the gradient fell along the step.
    """
    along = curvature @ step
    expected, seen = float(step @ along), float(step @ change)
    if not expected > 0:
        return curvature
    share = 1.0 if seen >= 0.2 * expected else 0.8 * expected / (expected - seen)
    change = share * change + (1 - share) * along
    return curvature - torch.outer(along, along) / expected + torch.outer(change, change) / float(step @ change)

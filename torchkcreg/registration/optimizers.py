"""Optimisers of a registration stage: CMA-ES by ask and tell, Adam and Gauss-Newton by steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from .config import Stage

_NEGLIGIBLE = 2e-5  # of the loss


class Problem(Protocol):
    """What an optimiser needs to know of a stage."""

    num_parameters: int

    def losses(self, candidates: Tensor) -> Tensor:
        """Losses (K,) of candidates (K, D)."""

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (D,) at one vector (D,)."""

    def curvature(self, parameters: Tensor) -> Tensor:
        """Gauss-Newton approximation (D, D) of the loss's second derivatives."""

    def project(self, parameters: Tensor) -> Tensor:
        """The nearest vector inside the bounds."""


@dataclass(frozen=True)
class Progress:
    """State after an iteration: its number, the best loss so far and the size of the last step, mm."""

    iteration: int
    loss: float
    step_mm: float


Report = Callable[[Progress], None]


def minimize(problem: Problem, stage: Stage, *, seed: int, report: Report) -> Tensor:
    """The best parameters (D,) that the stage's optimiser finds, starting from zero."""
    run = {"cmaes": cmaes, "adam": adam, "gauss-newton": gauss_newton}[stage.optimizer]
    return run(problem, stage, seed, report)


def cmaes(problem: Problem, stage: Stage, seed: int, report: Report) -> Tensor:
    """Covariance matrix adaptation evolution strategy (library ``cma``); a whole generation is one batch."""
    import cma  # late: it brings a plotting library along, and few registrations need it

    options = {
        "popsize": stage.population,
        "maxiter": stage.iterations,
        "seed": math.nan,  # which leaves NumPy's global generator alone
        "randn": np.random.RandomState(seed + 1).randn,
        "verbose": -9,
        "verb_log": 0,
        "tolfun": 0.0,
        "tolfunhist": 0.0,
        "tolx": 0.0,
        "tolstagnation": stage.iterations,
    }
    strategy = cma.CMAEvolutionStrategy(np.zeros(problem.num_parameters), stage.step_mm, options)
    while not strategy.stop():
        candidates = strategy.ask()
        batch = problem.project(torch.as_tensor(np.stack(candidates), dtype=torch.float64))
        losses = problem.losses(batch)
        strategy.tell(candidates, losses.tolist())
        spread = float(strategy.sigma * np.sqrt(np.mean(strategy.C.diagonal() if strategy.C.ndim == 2 else strategy.C)))
        report(Progress(strategy.countiter, float(strategy.best.f), spread))
        if spread < stage.tolerance:
            break
    ends = torch.as_tensor(np.stack([strategy.mean, strategy.best.x, np.zeros_like(strategy.mean)]))
    ends = problem.project(ends)
    return ends[int(problem.losses(ends).argmin())]


def adam(problem: Problem, stage: Stage, seed: int, report: Report) -> Tensor:
    """Adam (Kingma & Ba 2015) with a cosine-shaped learning rate; returns the best vector it saw."""
    parameters = torch.zeros(problem.num_parameters, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([parameters], lr=stage.step_mm)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, stage.iterations, eta_min=0.02 * stage.step_mm)
    best, best_loss = parameters.detach().clone(), float("inf")
    for iteration in range(1, stage.iterations + 1):
        before = parameters.detach().clone()
        loss, gradient = problem.loss_and_gradient(before)
        if loss < best_loss:
            best, best_loss = before, loss
        parameters.grad = gradient
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            parameters.copy_(problem.project(parameters[None])[0])
        step = float((parameters.detach() - before).abs().max())
        report(Progress(iteration, best_loss, step))
        if step < stage.tolerance:
            break
    return best


def gauss_newton(problem: Problem, stage: Stage, seed: int, report: Report) -> Tensor:
    """Gauss-Newton with Levenberg-Marquardt damping (Marquardt 1963) and steps of at most ``stage.step_mm``.

    The gradient is exact; the curvature is taken once and again when steps stop agreeing with it. It also ends with a
    step that is taken and promised next to nothing: it moved what the images hardly show by micrometres.
    """
    parameters = torch.zeros(problem.num_parameters, dtype=torch.float64)
    loss, gradient = problem.loss_and_gradient(parameters)
    curvature, fresh = problem.curvature(parameters), True
    damping, iteration = 1e-3, 0
    while iteration < stage.iterations:
        iteration += 1
        trial = _within_bounds(problem, parameters, curvature, gradient, damping, stage.step_mm)
        step = trial - parameters
        predicted = float(-(gradient @ step) - 0.5 * step @ curvature @ step)
        trial_loss = float(problem.losses(trial[None])[0])
        size = float(step.abs().max())
        gain = (loss - trial_loss) / max(predicted, 1e-16)
        taken = trial_loss < loss
        if taken:
            parameters = trial
            loss, gradient = problem.loss_and_gradient(parameters)
            damping = max(damping / 5, 1e-6) if gain > 0.5 else damping * 2
            fresh = False
        else:
            damping *= 8
        report(Progress(iteration, loss, size))
        if size < stage.tolerance or (taken and predicted < _NEGLIGIBLE * loss):
            break
        if not fresh and gain < 0.25:
            curvature, fresh = problem.curvature(parameters), True
        elif fresh and damping > 1e6:
            break
    return parameters


def _within_bounds(
    problem: Problem, parameters: Tensor, curvature: Tensor, gradient: Tensor, damping: float, longest: float
) -> Tensor:
    """Where a damped step leads inside the bounds; the free parameters know which ones a bound holds back."""
    wanted = parameters + _damped_step(curvature, gradient, damping, longest)
    trial = problem.project(wanted[None])[0]
    free = trial == wanted
    if free.all() or not free.any():
        return trial
    held = (trial - parameters)[~free]
    rest = gradient[free] + curvature[free][:, ~free] @ held
    trial[free] = parameters[free] + _damped_step(curvature[free][:, free], rest, damping, longest)
    return problem.project(trial[None])[0]


def _damped_step(curvature: Tensor, gradient: Tensor, damping: float, longest: float) -> Tensor:
    """The Levenberg-Marquardt step, shortened until no parameter moves by more than ``longest``."""
    diagonal = curvature.diagonal()
    floor = 1e-6 * diagonal.mean()
    step = -torch.linalg.solve(curvature + torch.diag(damping * diagonal + floor), gradient)
    return step * min(1.0, longest / max(float(step.abs().max()), 1e-12))

"""Adam, step by step."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .optimizer import Optimizer, Options, Problem


class Adam(Optimizer):
    """Adam (Kingma & Ba 2015) with a cosine-shaped learning rate; returns the best vector visited."""

    uses_losses = False

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        super().__init__(problem, stage, seed)
        self._parameters = self._zeros().requires_grad_(True)
        self._best, self._loss = self._parameters.detach().clone(), math.inf
        self._adam = torch.optim.Adam([self._parameters], lr=stage.step_mm)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self._adam, stage.iterations, eta_min=0.02 * stage.step_mm
        )

    def ask(self) -> Tensor:
        """Current vector, as a batch of one."""
        return self._parameters.detach().clone()[None]

    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """Take one Adam step with the gradient of the loss. `losses` are not used."""
        before = candidates[0]
        loss, self._parameters.grad = self.problem.loss_and_gradient(before)
        if loss < self._loss:
            self._best, self._loss = before.clone(), loss
        self._adam.step()
        self._schedule.step()
        with torch.no_grad():
            self._parameters.copy_(self.problem.project(self._parameters[None])[0])
        step = float((self._parameters.detach() - before).abs().max())
        self._advance(self._loss, step, end=step < self.stage.tolerance)

    def best(self) -> Tensor:
        """Visited vector with the lowest loss."""
        return self._best

    def state_dict(self) -> dict[str, Any]:
        """Vectors, moments and learning rate, for a checkpoint."""
        return {
            "parameters": self._parameters.detach().clone(),
            "best": self._best.clone(),
            "loss": self._loss,
            "adam": self._adam.state_dict(),
            "schedule": self._schedule.state_dict(),
            **self._ended(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a checkpoint."""
        with torch.no_grad():
            self._parameters.copy_(state["parameters"])
        self._best, self._loss = state["best"].clone(), state["loss"]
        self._adam.load_state_dict(state["adam"])
        self._schedule.load_state_dict(state["schedule"])
        self._end_as(state)

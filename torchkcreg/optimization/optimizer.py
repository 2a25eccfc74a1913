"""Interface of the optimisers of a registration's stages: `ask` for candidates, `tell` their losses."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor


class Options(Protocol):
    """Limits of an optimiser. A stage of a registration provides them.

    Attributes:
        iterations: Largest number of iterations.
        tolerance: The optimiser ends when an iteration moves the implant by less, mm.
        step_mm: First, or longest, step, mm.
        population: Candidates per generation, for optimisers with generations.
    """

    @property
    def iterations(self) -> int:
        """Largest number of iterations."""
        ...

    @property
    def tolerance(self) -> float:
        """Smallest motion of the implant in an iteration, mm."""
        ...

    @property
    def step_mm(self) -> float:
        """First, or longest, step, mm."""
        ...

    @property
    def population(self) -> int:
        """Candidates per generation."""
        ...


class Problem(Protocol):
    """Objective of a stage. Parameters are float64 and zero at the start of the stage."""

    num_parameters: int
    device: torch.device

    def losses(self, candidates: Tensor) -> Tensor:
        """Losses (K,) of candidates (K, D)."""

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (D,) at one vector (D,)."""

    def curvature(self, parameters: Tensor) -> Tensor:
        """Gauss-Newton approximation (D, D) of the loss's second derivatives."""

    def project(self, parameters: Tensor) -> Tensor:
        """Nearest vectors (K, D) inside the bounds."""


@dataclass(frozen=True)
class Progress:
    """State after an iteration: its number, the best loss so far and the size of the last step, mm."""

    iteration: int
    loss: float
    step_mm: float


class Optimizer(ABC):
    """Base class of optimisers: repeats `ask` and `tell` until `done`, see `iterate`.

    Args:
        problem: Objective of the stage.
        stage: Iterations, tolerance, steps, population.
        seed: Seed of the random numbers.

    Attributes:
        uses_losses: True if `tell` uses the losses. If False, they are not computed.
        progress: State after the last iteration.
        done: True if it has ended.
        converged: True if it ended for another reason than the limit of iterations.
    """

    uses_losses: ClassVar[bool] = True

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        self.problem, self.stage, self.seed = problem, stage, seed
        self.progress = Progress(0, math.inf, math.inf)
        self.done = self.converged = False

    @abstractmethod
    def ask(self) -> Tensor:
        """Candidates (K, D), within the bounds, whose losses are needed."""

    @abstractmethod
    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """Complete an iteration with the losses (K,) of the candidates from `ask`."""

    @abstractmethod
    def best(self) -> Tensor:
        """Best parameters (D,) so far."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """State between two iterations as tensors and plain types, for `load_state_dict`."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of the same problem, stage and seed; continues exactly as without the interruption."""

    def _ended(self) -> dict[str, Any]:
        """Part of the state that all optimisers share."""
        return {"progress": list(vars(self.progress).values()), "done": self.done, "converged": self.converged}

    def _end_as(self, state: dict[str, Any]) -> None:
        self.progress = Progress(*state["progress"])
        self.done, self.converged = state["done"], state["converged"]

    def _advance(self, loss: float, step_mm: float, *, end: bool) -> None:
        self.progress = Progress(self.progress.iteration + 1, loss, step_mm)
        self.converged = end
        self.done = end or self.progress.iteration >= self.stage.iterations

    def _zeros(self) -> Tensor:
        start = torch.zeros(self.problem.num_parameters, dtype=torch.float64, device=self.problem.device)
        return self.problem.project(start[None])[0]


def iterate(optimizer: Optimizer) -> None:
    """Run one iteration."""
    candidates = optimizer.ask()
    losses = optimizer.problem.losses(candidates) if optimizer.uses_losses else candidates.new_zeros(len(candidates))
    optimizer.tell(candidates, losses)

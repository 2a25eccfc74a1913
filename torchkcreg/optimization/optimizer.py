"""What an optimiser of a registration's stages is: it asks for losses of candidates and is told them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor


class Options(Protocol):
    """How long an optimiser may walk, and how far at a time; a stage of a registration is one.

    Attributes:
        iterations: At most so many.
        tolerance: It ends when an iteration moves the implant by less, mm.
        step_mm: Its first, or longest, step.
        population: Candidates of a generation, where it has generations.
    """

    @property
    def iterations(self) -> int: ...

    @property
    def tolerance(self) -> float: ...

    @property
    def step_mm(self) -> float: ...

    @property
    def population(self) -> int: ...


class Problem(Protocol):
    """What an optimiser may ask of a stage. Parameters are float64; zero is where the stage starts."""

    num_parameters: int
    device: torch.device

    def losses(self, candidates: Tensor) -> Tensor:
        """Losses (K,) of candidates (K, D)."""

    def loss_and_gradient(self, parameters: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (D,) at one vector (D,)."""

    def curvature(self, parameters: Tensor) -> Tensor:
        """Gauss-Newton approximation (D, D) of the loss's second derivatives."""

    def project(self, parameters: Tensor) -> Tensor:
        """The nearest vectors (K, D) inside the bounds."""


@dataclass(frozen=True)
class Progress:
    """State after an iteration: its number, the best loss so far and the size of the last step, mm."""

    iteration: int
    loss: float
    step_mm: float


class Optimizer(ABC):
    """Asks for the losses of candidates and is told them, until it is done.

    Args:
        problem: The stage's objective.
        stage: Iterations, tolerance, steps, population.
        seed: Of the random numbers.

    Attributes:
        uses_losses: Whether `tell` looks at the losses; one that takes derivatives alone spares them.
        progress: After the last iteration.
        done: Whether it has ended.
        converged: Whether it ended for another reason than that its iterations did.
    """

    uses_losses: ClassVar[bool] = True

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        self.problem, self.stage, self.seed = problem, stage, seed
        self.progress = Progress(0, math.inf, math.inf)
        self.done = self.converged = False

    @abstractmethod
    def ask(self) -> Tensor:
        """Candidates (K, D), within the bounds, whose losses it wants to know."""

    @abstractmethod
    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """Takes up losses (K,) of the candidates that it asked for: one iteration."""

    @abstractmethod
    def best(self) -> Tensor:
        """The best parameters (D,) that it has found."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain types from which :meth:`load_state_dict` goes on, in between two iterations."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from there, with the same problem, stage and seed, as if it had never stopped."""

    def _ended(self) -> dict[str, Any]:
        """What every optimiser keeps."""
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
    """One iteration."""
    candidates = optimizer.ask()
    losses = optimizer.problem.losses(candidates) if optimizer.uses_losses else candidates.new_zeros(len(candidates))
    optimizer.tell(candidates, losses)

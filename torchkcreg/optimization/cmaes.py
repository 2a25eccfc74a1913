"""CMA-ES, generation by generation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .optimizer import Optimizer, Options, Problem


class CMAES(Optimizer):
    """Covariance matrix adaptation evolution strategy (library `cma`); each generation is one batch."""

    def __init__(self, problem: Problem, stage: Options, seed: int) -> None:
        import cma  # imported here because it loads a plotting library and few registrations need it

        super().__init__(problem, stage, seed)
        options = {
            "popsize": stage.population,
            "maxiter": stage.iterations,
            "seed": math.nan,  # NaN: NumPy's global generator is not seeded
            "randn": np.random.RandomState(seed + 1).randn,
            "verbose": -9,
            "verb_log": 0,
            "tolfun": 0.0,
            "tolfunhist": 0.0,
            "tolx": 0.0,
            "tolstagnation": stage.iterations,
        }
        self._strategy = cma.CMAEvolutionStrategy(np.zeros(problem.num_parameters), stage.step_mm, options)
        self._told: list[list[float]] = []
        self._asked: list[np.ndarray] = []

    def ask(self) -> Tensor:
        """Candidates of a new generation."""
        self._asked = self._strategy.ask()
        return self._bounded(np.stack(self._asked))

    def tell(self, candidates: Tensor, losses: Tensor) -> None:
        """Update the distribution with the losses of the generation."""
        strategy = self._strategy
        self._told.append(losses.tolist())
        strategy.tell(self._asked, self._told[-1])
        spread = float(strategy.sigma * np.sqrt(np.mean(strategy.C.diagonal() if strategy.C.ndim == 2 else strategy.C)))
        ended = bool(strategy.stop()) and strategy.countiter < self.stage.iterations
        self._advance(float(strategy.best.f), spread, end=spread < self.stage.tolerance or ended)

    def best(self) -> Tensor:
        """Best of three vectors: the mean, the best candidate and the start."""
        strategy = self._strategy
        ends = self._bounded(np.stack([strategy.mean, strategy.best.x, np.zeros_like(strategy.mean)]))
        return ends[int(self.problem.losses(ends).argmin())]

    def state_dict(self) -> dict[str, Any]:
        """All losses so far. With the same seed they reproduce the state."""
        return {"losses": [list(losses) for losses in self._told]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a checkpoint by replaying all losses on a new strategy."""
        self.__init__(self.problem, self.stage, self.seed)  # type: ignore[misc]
        for losses in state["losses"]:
            self.tell(self.ask(), torch.tensor(losses, dtype=torch.float64, device=self.problem.device))

    def _bounded(self, candidates: np.ndarray) -> Tensor:
        return self.problem.project(torch.as_tensor(candidates, dtype=torch.float64, device=self.problem.device))

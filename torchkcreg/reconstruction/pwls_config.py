"""Options of PWLS: how many iterations of how many ordered subsets, and how smooth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import Field

from torchkcreg.config import Config

PRESETS = ("momentum", "paper")


@dataclass(frozen=True)
class SubsetStage:
    """Some iterations with one number of ordered subsets.

    Attributes:
        iterations: how many.
        subsets: how many.
        momentum: whether steps start from a point ahead.
    """

    iterations: int
    subsets: int
    momentum: bool = True

    def check(self, num_views: int) -> None:
        """Nothing; ValueError where there are more subsets than views."""
        if self.subsets > num_views:
            raise ValueError(f"subsets must be at most the number of views {num_views}, got {self.subsets}")


class PWLSConfig(Config):
    """Options of `pwls`.

    Attributes:
        iterations: passes through all views.
        subsets: ordered subsets at the start.
        momentum: Nesterov's momentum. The number of subsets then halves after each quarter of the iterations, which
            keeps the errors of subsets from adding up in the momentum and lets the run converge.
        beta: weight of the roughness, in the unit of the weights times mm^2.
        nonnegative: no attenuation below zero.
        objective_every: compute the exact objective after every so many iterations (half as much work as an iteration);
            0: never.

    >>> PWLSConfig.preset("paper").stages()
    [SubsetStage(iterations=500, subsets=20, momentum=False)]
    """

    iterations: int = Field(50, ge=1)
    subsets: int = Field(20, ge=1)
    momentum: bool = True
    beta: float = Field(10.0, ge=0, allow_inf_nan=False)
    nonnegative: bool = True
    objective_every: int = Field(0, ge=0)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> PWLSConfig:
        """Named options: "paper", 500 iterations of 20 subsets (Cao et al. 2020); "momentum", 50 with momentum."""
        if name not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
        if name == "paper":
            return cls(**({"iterations": 500, "subsets": 20, "momentum": False} | changes))
        return cls(**changes)

    def stages(self) -> list[SubsetStage]:
        """The run's stages."""
        if not self.momentum:
            return [SubsetStage(self.iterations, self.subsets, False)]
        quarters = [self.iterations * (i + 1) // 4 - self.iterations * i // 4 for i in range(4)]
        stages = []
        for count, part in zip(quarters, range(4)):
            if count:
                stages.append(SubsetStage(count, max(1, self.subsets >> part)))
        return stages

    def stage(self, iteration: int) -> SubsetStage:
        """The stage of an iteration, counted from 0."""
        stages = self.stages()
        for stage in stages:
            if iteration < stage.iterations:
                return stage
            iteration -= stage.iterations
        return stages[-1]

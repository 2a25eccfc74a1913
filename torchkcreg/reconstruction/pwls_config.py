"""Options of PWLS: how many iterations of how many ordered subsets, and how smooth."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

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


@dataclass(frozen=True)
class PWLSConfig:
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

    Raises:
        ValueError: counts that are not positive, or a beta below zero.

    >>> PWLSConfig.preset("paper").stages()
    [SubsetStage(iterations=500, subsets=20, momentum=False)]
    """

    iterations: int = 50
    subsets: int = 20
    momentum: bool = True
    beta: float = 10.0
    nonnegative: bool = True
    objective_every: int = 0

    def __post_init__(self) -> None:
        for name, least in (("iterations", 1), ("subsets", 1), ("objective_every", 0)):
            value = getattr(self, name)
            if int(value) != value or value < least:
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value}")
        if not (math.isfinite(self.beta) and self.beta >= 0):
            raise ValueError(f"beta must not be negative, got {self.beta}")

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

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)

"""Optimisers with an ask-and-tell interface, and the names by which stages select them.

To use your own, derive a class from `Optimizer` and add it to `OPTIMIZERS`, or pass it to `register`.
"""

from collections.abc import Callable

from .adam import Adam
from .cmaes import CMAES
from .gauss_newton import GaussNewton
from .optimizer import Optimizer, Options, Problem, Progress, iterate

OptimizerFactory = Callable[[Problem, Options, int], Optimizer]

OPTIMIZERS: dict[str, OptimizerFactory] = {
    "gauss-newton": GaussNewton,
    "cmaes": CMAES,
    "adam": Adam,
}

__all__ = [
    "CMAES",
    "OPTIMIZERS",
    "Adam",
    "GaussNewton",
    "Optimizer",
    "OptimizerFactory",
    "Options",
    "Problem",
    "Progress",
    "iterate",
]

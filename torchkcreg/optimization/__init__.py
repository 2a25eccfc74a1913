"""Optimisers behind ask and tell, and the names that stages call them by. One of your own is a class like these, and a
line here or an argument of `register`.
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

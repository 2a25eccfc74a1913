"""The optimisers that stages call by name; one of your own is a class like these, and a line here or an argument."""

from __future__ import annotations

from collections.abc import Callable

from .adam import Adam
from .cmaes import CMAES
from .config import Stage
from .gauss_newton import GaussNewton
from .optimizer import Optimizer, Problem

OptimizerFactory = Callable[[Problem, Stage, int], Optimizer]

OPTIMIZERS: dict[str, OptimizerFactory] = {
    "gauss-newton": GaussNewton,
    "cmaes": CMAES,
    "adam": Adam,
}

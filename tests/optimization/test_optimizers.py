"""Optimisers behind ask and tell, on functions of two parameters."""

from __future__ import annotations

import numpy as np
import torch

from torchkcreg.optimization import CMAES, GaussNewton, Optimizer, iterate
from torchkcreg.optimization.gauss_newton import learned
from torchkcreg.registration import Stage


def minimum(optimizer: Optimizer) -> torch.Tensor:
    while not optimizer.done:
        iterate(optimizer)
    return optimizer.best()


class _Bowl:
    num_parameters, device = 2, torch.device("cpu")

    def losses(self, candidates: torch.Tensor) -> torch.Tensor:
        return (candidates - 0.3).square().sum(-1)

    def project(self, parameters: torch.Tensor) -> torch.Tensor:
        return parameters


def test_cma_es_leaves_the_callers_random_numbers_alone() -> None:
    stage = Stage(optimizer="cmaes", iterations=20)
    np.random.seed(5)  # noqa: NPY002
    expected = np.random.random(3)  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    found = [minimum(CMAES(_Bowl(), stage, 7)) for _ in range(2)]
    assert np.array_equal(np.random.random(3), expected)  # noqa: NPY002
    assert torch.equal(*found)
    assert not torch.equal(found[0], minimum(CMAES(_Bowl(), stage, 8)))
    torch.testing.assert_close(found[0], torch.full((2,), 0.3, dtype=torch.float64), atol=0.02, rtol=0)


class _Valley:
    """A narrow valley along which two parameters trade; its bottom lies beyond the bound of the first one."""

    num_parameters, device = 2, torch.device("cpu")
    bottom = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    matrix = torch.tensor([[1.0, 0.99], [0.99, 1.0]], dtype=torch.float64)

    def losses(self, candidates: torch.Tensor) -> torch.Tensor:
        off = candidates - self.bottom
        return 1 + ((off @ self.matrix) * off).sum(-1)

    def loss_and_gradient(self, parameters: torch.Tensor) -> tuple[float, torch.Tensor]:
        return float(self.losses(parameters[None])[0]), 2 * self.matrix @ (parameters - self.bottom)

    def curvature(self, parameters: torch.Tensor) -> torch.Tensor:
        return 2 * self.matrix

    def project(self, parameters: torch.Tensor) -> torch.Tensor:
        return torch.stack([parameters[:, 0].clamp_min(0.0), parameters[:, 1]], dim=-1)


def test_a_parameter_at_its_bound_does_not_lead_the_others_astray() -> None:
    """Where the first is held at 0 the best of the second is 0.01, not the 1 that goes with the first at -1."""
    stage = Stage(optimizer="gauss-newton", iterations=3, tolerance=1e-9, step_mm=10.0)
    found = minimum(GaussNewton(_Valley(), stage, 0))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.01], dtype=torch.float64), atol=1e-3, rtol=0)


def test_a_step_teaches_the_curvature_along_it_and_never_makes_it_negative() -> None:
    root = torch.rand(5, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    true, guess = root @ root.T + torch.eye(5), 0.4 * torch.eye(5, dtype=torch.float64)
    for step in torch.eye(5, dtype=torch.float64):
        guess = learned(guess, step, true @ step)
        torch.testing.assert_close(guess @ step, true @ step)
    step = torch.ones(5, dtype=torch.float64)
    after = learned(guess, step, -3 * step)  # a gradient that fell along the step
    assert float(torch.linalg.eigvalsh(after)[0]) > 0 and float(step @ after @ step) < float(step @ guess @ step)
    torch.testing.assert_close(learned(guess, 0 * step, step), guess)

"""Weights that stop counting what the model cannot explain."""

import torch

from torchkcreg.registration.objective import residual_weights
from torchkcreg.similarity import GradientCorrelation, sobel_gradient


def scenes() -> tuple[torch.Tensor, torch.Tensor]:
    """A bar that the model knows, and the bar with noise and a bead that it does not know; (1, 48, 48) each."""
    u = torch.arange(48.0)
    bar = ((u > 10) & (u < 30)).float() * ((u > 4) & (u < 44)).float()[:, None].expand(1, 48, 48)
    seen = bar + 0.005 * torch.randn(bar.shape, generator=torch.Generator().manual_seed(0))
    seen[0, 20:26, 38:44] += 1.0
    return bar, seen


def weights_of(model: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    similarity = GradientCorrelation(seen)
    residuals = similarity.residuals(model[None])[0]
    return residual_weights(residuals, sobel_gradient(model), torch.ones(model.shape))


def test_an_unknown_bead_loses_its_weight_and_the_known_edge_keeps_it() -> None:
    weights = weights_of(*scenes())[0]
    assert float(weights[22, 37]) < 0.1
    assert float(weights[5:15, 10].mean()) > 0.3


def test_weights_let_the_correlation_forget_the_bead() -> None:
    bar, seen = scenes()
    plain, weighted = GradientCorrelation(seen), GradientCorrelation(seen, weights=weights_of(bar, seen))
    assert float(weighted(bar[None])[0, 0]) > float(plain(bar[None])[0, 0]) + 0.05


def test_a_flat_rendering_keeps_every_weight() -> None:
    _, seen = scenes()
    assert (weights_of(torch.zeros_like(seen), seen) == 1).all()

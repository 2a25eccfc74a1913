"""Weights of pixels that stop counting what the model cannot explain: bone edges, beads, cables."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.physics import gaussian_blur

_EDGE = 0.05  # a pixel lies on an edge of the model if its squared gradient has this share of the largest
_WINDOW_PX = 2.0


def residual_weights(residuals: Tensor, rendered: Tensor, valid: Tensor) -> Tensor:
    """Weights (V, rows, cols), 1 where the model fits, towards 0 where it does not.

    ``w = 1 / (1 + e / m)`` with e the squared residual, averaged over a few pixels, and m its median over the edges of
    the rendered image: the weights of a Cauchy distribution for iteratively reweighted least squares (Holland & Welsch
    1977). The scale is the residual on the implant's own edges, so that a view in which the model fits badly
    everywhere keeps its weights.

    Args:
        residuals: Of the unit gradients, shape (V, 2, rows, cols).
        rendered: Gradients of the rendered images, shape (V, 2, rows, cols).
        valid: Pixels that count, shape (V, rows, cols).
    """
    valid = valid.to(residuals)
    energy = gaussian_blur(residuals.square().sum(1) * valid, _WINDOW_PX)
    edges = rendered.square().sum(1) * valid
    weights = torch.ones_like(energy)
    for view, (misfit, edge) in enumerate(zip(energy, edges, strict=True)):
        on_edge = edge > _EDGE * edge.max()
        if on_edge.any():
            weights[view] = 1 / (1 + misfit / misfit[on_edge].median().clamp_min(torch.finfo(misfit.dtype).tiny))
    return weights

"""Scatter as two broad images: one from what passes the object, one from what the object takes from the beam."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.physics.blur import gaussian_blur


def scatter_shapes(transmission: Tensor, mask: Tensor, sigma_px: float) -> Tensor:
    """How both kinds of scatter are spread over the detector, shape (2, V, rows, cols).

    Single scatter forward comes with the beam that passes, `p = G I` (Sun & Star-Lack 2010); what comes from the side
    goes with what is removed on the way, `q = G (-I ln I)` (Ohnesorge et al. 1999). In front of a limb that stands in
    the open beam the one falls where the other rises.

    Args:
        transmission: Measured transmission I, shape (V, rows, cols).
        mask: What share of each pixel counts, same shape.
        sigma_px: Width of the Gaussian G, pixels.
    """
    passed = transmission.clamp(0, 1)
    sources = torch.stack([transmission, -torch.xlogy(passed, passed)])
    return gaussian_blur(sources * mask, sigma_px) / gaussian_blur(mask, sigma_px).clamp_min(1e-3)


def scattered_signal(levels: Tensor, shapes: Tensor | None) -> Tensor:
    """Scatter `s p + r q` of candidates in units of the open beam, a shape that broadcasts to (K, V, rows, cols).

    Args:
        levels: s and r, shape (K, 2).
        shapes: p and q, shape (2, V, rows, cols); None: p is even, and q is nothing.
    """
    if shapes is None:
        return levels[:, 0, None, None, None]
    return torch.einsum("ks,svij->kvij", levels.to(shapes), shapes)

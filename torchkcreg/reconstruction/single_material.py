"""Scans of one material alone: transmissions to path lengths through it, exactly."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.physics import Material, Spectrum

_STEPS = 4096
_DARKEST = 12.0  # line integral beyond which nothing is told apart


def path_lengths_through(transmission: Tensor, substance: Material, spectrum: Spectrum) -> Tensor:
    """Path lengths in mm, of the shape of the transmissions, through an object of one material: no beam hardening.

    The inverse of ``T(L) = sum_k w_k exp(-mu_k L)``, interpolated in ``-ln T``; below no material at all (brighter than
    the open beam) as for monoenergetic light, so that noise has no bias.

    Args:
        transmission: Measured intensity over the open beam's, scatter taken away; positive.
        substance: What the object is of.
        spectrum: As detected.
    """
    weights = torch.tensor(spectrum.weights, dtype=torch.float64, device="cpu")
    attenuation = substance.attenuation(spectrum.energies_kev)
    longest = _DARKEST / float(attenuation.min())
    lengths = torch.linspace(0, 1, _STEPS, dtype=torch.float64, device="cpu").square() * longest
    lines = -(torch.exp(-lengths[:, None] * attenuation) @ weights).log()
    table, lengths = lines.to(transmission.device), lengths.to(transmission.device)
    measured = -transmission.double().clamp_min(1e-30).log()
    upper = torch.searchsorted(table, measured.contiguous()).clamp(1, _STEPS - 1)
    low, high = table[upper - 1], table[upper]
    share = (measured - low) / (high - low)
    return torch.lerp(lengths[upper - 1], lengths[upper], share).to(transmission.dtype)

"""Elastic energy of an implant's material at finite rotations."""

from __future__ import annotations

import torch
from torch import Tensor


def strain_energy(gradients: Tensor, volumes: Tensor, *, poisson: float = 0.0) -> Tensor:
    """Mean elastic energy density per unit of Young's modulus, shape (...), of a Saint Venant-Kirchhoff solid.

    ``lambda / 2 tr(E)^2 + mu E : E`` with the Green-Lagrange strain ``E = (F^T F - I) / 2``, which no rigid motion
    changes, however large: a bent plate whose ends turn by degrees is charged for its bending alone. A plate of
    thickness h bent to curvature k has ``(k h)^2 / 24``.

    Args:
        gradients: Deformation gradients F at the nodes, shape (..., N, 3, 3).
        volumes: Volumes of the nodes, shape (N,), mm^3.
        poisson: Poisson's ratio. Zero suits control points that move in rigid groups: those cannot contract sideways,
            and would make an implant that wants to look stiffer than it is.

    Raises:
        ValueError: If poisson is not from 0 up to, but not including, 0.5.

    Example:
        >>> stretch = torch.diag(torch.tensor([1.01, 1.0, 1.0]))
        >>> round(float(strain_energy(stretch[None], torch.ones(1))) * 1e6, 2)
        50.5
    """
    if not 0 <= poisson < 0.5:
        raise ValueError(f"poisson must be from 0 up to, but not including, 0.5, got {poisson}")
    strain = 0.5 * (gradients.mT @ gradients - torch.eye(3, dtype=gradients.dtype, device=gradients.device))
    first = poisson / ((1 + poisson) * (1 - 2 * poisson))
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    density = 0.5 * first * trace**2 + 0.5 / (1 + poisson) * strain.square().sum((-2, -1))
    return (density * (volumes / volumes.sum()).to(density)).sum(-1)

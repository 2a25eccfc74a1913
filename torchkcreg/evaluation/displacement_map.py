"""Displacement maps: bending of an implant relative to its distal end (fig. 3B of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, principal_axes, transform_points


@dataclass(frozen=True)
class DisplacementMap:
    """Displacements of an implant's nodes relative to its distal end.

    Attributes:
        undeformed: Undeformed nodes (N, 3), aligned with the deformed ones at the distal end, world mm.
        vectors: Displacements (N, 3) from the undeformed to the deformed nodes, mm.
        magnitudes: Lengths (N,) of the displacements, mm.
        distal: True for the nodes used for the alignment, bool (N,).
        alignment: Rigid motion (4, 4) of the undeformed nodes into the world.
    """

    undeformed: Tensor
    vectors: Tensor
    magnitudes: Tensor
    distal: Tensor
    alignment: Tensor

    @property
    def deformed(self) -> Tensor:
        """The deformed nodes (N, 3) in the world, mm."""
        return self.undeformed + self.vectors


def displacement_map(
    points: Tensor,
    warped: Tensor,
    *,
    distal_fraction: float = 0.25,
    weights: Tensor | None = None,
    distal_direction: tuple[float, float, float] = (0.0, 0.0, -1.0),
) -> DisplacementMap:
    """Displacement of each node of an implant, with undeformed and deformed implant aligned at the distal end.

    "The bottom portions of undeformed and deformed point clouds were first rigidly registered, and the Euclidean
    distance between the two clouds at every node was then calculated" (section 2.4 of Cao et al. 2020). Rigid
    motion of the implant is removed: an implant that only moved has a map of zeros.

    Args:
        points: Nodes (N, 3) of the undeformed implant, in any frame, mm.
        warped: The same nodes deformed, (N, 3) in the world, mm.
        distal_fraction: Share of the implant's length, from the distal end, that is aligned; in (0, 1].
        weights: Weights (N,) such as the nodes' volumes; equal if None.
        distal_direction: Direction to the distal end in the world; by default down, away from the body. The end of
            the implant's long axis that lies farther in this direction is the distal one.

    Raises:
        ValueError: Shapes differ, the fraction is outside (0, 1], or fewer than three nodes lie in the distal part.

    >>> straight = torch.tensor([[x, 0.0, z] for z in range(9) for x in range(2)])
    >>> bent = straight + torch.tensor([[0.0, max(0.0, z - 4.0), 0.0] for z in range(9) for x in range(2)])
    >>> displacement_map(straight, bent).magnitudes[::2].abs().round(decimals=3).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0]
    """
    if points.ndim != 2 or points.shape[-1] != 3 or points.shape != warped.shape:
        shapes = f"{tuple(points.shape)} and {tuple(warped.shape)}"
        raise ValueError(f"points and warped must both have shape (N, 3), got {shapes}")
    if not 0 < distal_fraction <= 1:
        raise ValueError(f"distal_fraction must be in (0, 1], got {distal_fraction}")
    points, warped = points.detach().double(), warped.detach().double().to(points.device)
    along = _along_the_implant(points, warped, torch.tensor(distal_direction, dtype=torch.float64))
    distal = along <= along.min() + distal_fraction * (along.max() - along.min())
    if int(distal.sum()) < 3:
        raise ValueError(f"distal_fraction {distal_fraction} holds {int(distal.sum())} nodes, at least 3 are needed")
    shares = None if weights is None else weights.to(points)[distal]
    alignment = fit_rigid(points[distal], warped[distal], shares)
    undeformed = transform_points(alignment, points)
    vectors = warped - undeformed
    return DisplacementMap(undeformed, vectors, torch.linalg.vector_norm(vectors, dim=-1), distal, alignment)


def _along_the_implant(points: Tensor, warped: Tensor, distal_direction: Tensor) -> Tensor:
    """Position (N,) of each node along the implant's long axis, smallest at the distal end."""
    center, (*_, axis) = principal_axes(points)
    along = (points - center) @ axis
    downwards = (warped - warped.mean(0)) @ distal_direction.to(warped)
    return along if float((along * downwards).sum()) <= 0 else -along

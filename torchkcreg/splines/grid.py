"""Lattice of control points around an implant."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import invert_rigid, transform_points


@dataclass(frozen=True, eq=False)
class ControlPointGrid:
    """Regular lattice of control points (CPs) in its own coordinate frame.

    CP (i, j, k) lies at (i sx, j sy, k sz) mm in the grid's frame. A cubic B-spline needs two CPs on each side of a
    point, so the valid domain spans CPs 1 to n - 2 along each axis.

    Attributes:
        shape: Numbers of CPs (nx, ny, nz), at least 4 each.
        spacing: Spacing (sx, sy, sz), mm.
        frame: Rigid transform (4, 4), float64, from the grid's frame to the implant's.

    Raises:
        ValueError: If a count, a spacing or the frame is invalid.

    Example:
        >>> grid = ControlPointGrid((6, 6, 10), (8.75, 8.75, 25.0), torch.eye(4))
        >>> grid.positions()[1, 0, 2].tolist(), grid.num_control_points
        ([8.75, 0.0, 50.0], 360)
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    frame: Tensor

    def __post_init__(self) -> None:
        shape, spacing = tuple(int(n) for n in self.shape), tuple(float(s) for s in self.spacing)
        if len(shape) != 3 or min(shape) < 4:
            raise ValueError(f"shape must hold three numbers of control points, each at least 4, got {self.shape}")
        if len(spacing) != 3 or not all(0 < s < math.inf for s in spacing):
            raise ValueError(f"spacing must hold three positive lengths in mm, got {self.spacing}")
        frame = self.frame.detach().to(torch.float64)
        if frame.shape != (4, 4) or not _is_rigid(frame):
            raise ValueError(f"frame must be a rigid (4, 4) transform, got shape {tuple(frame.shape)} {frame.tolist()}")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "frame", frame)

    def to(self, device: torch.device | str) -> ControlPointGrid:
        """The grid with its frame on another device."""
        moved = copy.copy(self)
        object.__setattr__(moved, "frame", self.frame.to(device))
        return moved

    @property
    def num_control_points(self) -> int:
        """Number of CPs, nx ny nz."""
        return math.prod(self.shape)

    def positions(self) -> Tensor:
        """CPs in the grid's frame, mm, shape (nx, ny, nz, 3), float64."""
        axes = [
            torch.arange(n, dtype=torch.float64, device=self.frame.device) * s
            for n, s in zip(self.shape, self.spacing, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)

    def to_dict(self) -> dict[str, Any]:
        """Shape, spacing and frame, for files."""
        return {"shape": list(self.shape), "spacing_mm": list(self.spacing), "grid_to_implant": self.frame}

    def to_grid(self, points: Tensor) -> Tensor:
        """Transform points (..., 3), mm, from the implant's frame to the grid's frame; keeps their dtype."""
        return transform_points(invert_rigid(self.frame).to(points.device), points)

    def to_implant(self, vectors: Tensor) -> Tensor:
        """Rotate vectors (..., 3), such as displacements, from the grid's axes to the implant's."""
        return vectors @ self.frame[:3, :3].T.to(vectors)

    def contains(self, points: Tensor) -> Tensor:
        """True for points (..., 3) of the implant's frame inside the valid domain, shape (...)."""
        spacing = torch.tensor(self.spacing, dtype=points.dtype, device=points.device)
        last = torch.tensor(self.shape, dtype=points.dtype, device=points.device) - 2
        knots = self.to_grid(points) / spacing
        return ((knots >= 1) & (knots <= last)).all(-1)


def default_grid(
    points: Tensor,
    *,
    shape: tuple[int, int, int] = (6, 6, 10),
    spacing: tuple[float, float, float] = (8.75, 8.75, 25.0),
    grows: bool = True,
) -> ControlPointGrid:
    """Grid centred on an implant, along its principal axes, the shortest first and the longest last.

    It has enough CPs that the implant lies in the valid domain with a margin of one spacing on each side, and at least
    `shape`. The defaults of shape and spacing are those of Cao et al. (2020).

    Args:
        points: Nodes of the implant in its frame, mm, shape (N, 3).
        shape: Smallest number of CPs along each axis.
        spacing: Spacing of the CPs, mm.
        grows: If False, the grid has exactly `shape` CPs. Parts of the implant outside the valid domain, at most one
            spacing long, then move with virtual CPs, see `spline_displacement`.

    Raises:
        ValueError: If there is no point, or one is not finite; if the implant is longer than a grid that may not grow.

    Example:
        >>> grid = default_grid(torch.rand(1000, 3) * torch.tensor([160.0, 4.0, 12.0]))
        >>> grid.shape, bool(grid.contains(torch.tensor([80.0, 2.0, 6.0])))
        ((6, 7, 12), True)
    """
    if points.ndim != 2 or points.shape[-1] != 3 or len(points) == 0 or not torch.isfinite(points).all():
        raise ValueError(f"points must be finite, of shape (N, 3) with N > 0, got {tuple(points.shape)}")
    points = points.detach().to(torch.float64)
    axes = _principal_axes(points)
    along = points @ axes
    low, high = along.amin(0), along.amax(0)
    counts = [
        # n CPs have a valid domain of n - 3 spacings, which must cover the extent and a spacing on either side.
        max(int(least), math.ceil(extent / step - 1e-9) + 5) if grows else int(least)
        for least, extent, step in zip(shape, (high - low).tolist(), spacing, strict=True)
    ]
    size = points.new_tensor([(n - 1) * s for n, s in zip(counts, spacing, strict=True)])
    if bool((high - low > size + 1e-6).any()):
        extent, span = (" x ".join(f"{length:.0f}" for length in lengths.tolist()) for lengths in (high - low, size))
        raise ValueError(
            f"the implant, {extent} mm, is longer than the grid of {' x '.join(map(str, counts))} control points, "
            f"{span} mm: give more (grid_shape) or let the grid grow (grid_grows)"
        )
    frame = torch.eye(4, dtype=torch.float64, device=points.device)
    frame[:3, :3] = axes
    frame[:3, 3] = axes @ ((low + high - size) / 2)
    return ControlPointGrid((counts[0], counts[1], counts[2]), spacing, frame)


def _principal_axes(points: Tensor) -> Tensor:
    """Principal axes as columns of a proper rotation, shortest first; the largest component of each is positive."""
    centered = points - points.mean(0)
    axes = torch.linalg.eigh(centered.T @ centered).eigenvectors
    largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
    axes = axes * torch.where(largest < 0, -1.0, 1.0)
    axes[:, 0] = torch.linalg.cross(axes[:, 1], axes[:, 2])
    return axes


def _is_rigid(frame: Tensor) -> bool:
    rotation = frame[:3, :3]
    identity = torch.eye(3, dtype=frame.dtype, device=frame.device)
    last = frame.new_tensor([0.0, 0.0, 0.0, 1.0])
    return bool(
        torch.isfinite(frame).all()
        and torch.allclose(rotation.T @ rotation, identity, atol=1e-6)
        and torch.linalg.det(rotation) > 0
        and torch.equal(frame[3], last)
    )

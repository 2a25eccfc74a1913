"""Errors of a registration at reference points: distances between estimated and true positions."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Protocol

import torch
from torch import Tensor


def point_errors(estimated: Tensor, truth: Tensor) -> Tensor:
    """Distances (..., N) in mm between estimated and true points (..., N, 3).

    Raises:
        ValueError: The shapes differ.

    >>> point_errors(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]])).tolist()
    [5.0]
    """
    if estimated.ndim < 2 or estimated.shape != truth.shape or estimated.shape[-1] != 3:
        shapes = f"{tuple(estimated.shape)} and {tuple(truth.shape)}"
        raise ValueError(f"estimated and truth must both have shape (..., N, 3), got {shapes}")
    return torch.linalg.vector_norm(estimated - truth.to(estimated), dim=-1)


def bb_rmse(estimated: Tensor, truth: Tensor) -> Tensor:
    """Root mean square (...) of the distances in mm between estimated and true points (..., N, 3).

    The paper's measure of a registration, with the reference BBs as points (section 2.4, table 1 of Cao et al. 2020).

    Raises:
        ValueError: The shapes differ, or there is no point.

    >>> bb_rmse(torch.zeros(2, 3), torch.tensor([[1.0, 0.0, 0.0], [0.0, 7.0, 0.0]])).item()
    5.0
    """
    errors = point_errors(estimated, truth)
    if errors.shape[-1] == 0:
        raise ValueError("bb_rmse needs at least one point, got none")
    return errors.square().mean(-1).sqrt()


@dataclass(frozen=True)
class PointMetrics:
    """Errors of a registration at reference points, all lengths in mm.

    Attributes:
        num_points: Number of reference points.
        rmse_mm: Root mean square distance.
        mean_mm: Mean distance.
        median_mm: Median distance.
        max_mm: Largest distance.
        rmse_xyz_mm: Root mean square error along world x, y and z; their squares add up to that of `rmse_mm`.
        motion_rms_mm: Root mean square of the points' true motion, if their start is known.
        num_outside: Number of points outside the control-point grid's valid domain, where the field is extrapolated.
        gc: Final gradient correlation of each view.
    """

    num_points: int
    rmse_mm: float
    mean_mm: float
    median_mm: float
    max_mm: float
    rmse_xyz_mm: tuple[float, float, float]
    motion_rms_mm: float | None = None
    num_outside: int | None = None
    gc: tuple[float, ...] | None = None

    def to_dict(self) -> dict[str, object]:
        """The metrics as plain data, without unknown ones."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def __str__(self) -> str:
        x, y, z = self.rmse_xyz_mm
        moved = "" if self.motion_rms_mm is None else f"; they moved {self.motion_rms_mm:.3f} mm (RMS)"
        outside = f"; {self.num_outside} beyond the control-point grid" if self.num_outside else ""
        return (
            f"{self.num_points} points: RMSE {self.rmse_mm:.3f} mm (x {x:.3f}, y {y:.3f}, z {z:.3f}), "
            f"mean {self.mean_mm:.3f}, median {self.median_mm:.3f}, largest {self.max_mm:.3f} mm{moved}{outside}"
        )


def evaluate_points(estimated: Tensor, truth: Tensor, *, start: Tensor | None = None) -> PointMetrics:
    """Errors of estimated positions of reference points such as BBs.

    Args:
        estimated: Positions (N, 3) estimated by the registration, mm.
        truth: True positions (N, 3), mm.
        start: Positions (N, 3) before the motion, to measure how far they moved, mm.

    Raises:
        ValueError: Shapes differ, or there is no point.

    >>> print(evaluate_points(torch.zeros(2, 3), torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.0, 0.1]])))
    2 points: RMSE 0.224 mm (x 0.212, y 0.000, z 0.071), mean 0.200, median 0.200, largest 0.300 mm
    """
    estimated, truth = estimated.detach().double(), truth.detach().double().to(estimated.device)
    if estimated.ndim != 2:
        raise ValueError(f"estimated must have shape (N, 3), got {tuple(estimated.shape)}")
    errors = point_errors(estimated, truth)
    rmse = bb_rmse(estimated, truth)
    x, y, z = (estimated - truth).square().mean(0).sqrt().tolist()
    return PointMetrics(
        num_points=len(errors),
        rmse_mm=float(rmse),
        mean_mm=float(errors.mean()),
        median_mm=float(errors.quantile(0.5)),
        max_mm=float(errors.max()),
        rmse_xyz_mm=(x, y, z),
        motion_rms_mm=None if start is None else float(bb_rmse(start.detach().double(), truth)),
    )


class Registered(Protocol):
    """Interface of registrations to evaluate, such as `torchkcreg.registration.RegistrationResult`."""

    gc: Tensor

    def warp(self, points: Tensor) -> Tensor:
        """World positions of points of the implant's frame."""

    def outside(self, points: Tensor) -> Tensor:
        """True for points where the deformation is extrapolated."""


def evaluate(result: Registered, points: Tensor, truth: Tensor, *, start: Tensor | None = None) -> PointMetrics:
    """Errors of a registration at reference points such as BBs, with its gradient correlations.

    Args:
        result: The registration.
        points: Reference points (N, 3) in the implant's frame, on or near the undeformed implant, mm.
        truth: True positions (N, 3) in the world at the time of the projections, mm.
        start: Positions (N, 3) before the motion, to measure how far they moved, mm.

    Raises:
        ValueError: Shapes differ, or there is no point.
    """
    points = points.double()
    metrics = evaluate_points(result.warp(points), truth, start=start)
    return replace(metrics, num_outside=int(result.outside(points).sum()), gc=tuple(result.gc.tolist()))

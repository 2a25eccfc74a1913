"""Motion of cross-sections along a bending implant, linear and with finite rotations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import rotation_from_vector
from torchkcreg.implant import ImplantPointCloud


@dataclass(frozen=True, eq=False)
class Sections:
    """Stations along an implant's longest axis, with linear interpolation between neighbouring stations.

    Attributes:
        axis: Unit vector (3,) in the implant's frame.
        heights: Positions (S,) of the stations along the axis, ascending, evenly spaced, mm.
        centers: Centres (S, 3) of the metal around each station, in the implant's frame, mm.
    """

    axis: Tensor
    heights: Tensor
    centers: Tensor

    @classmethod
    def along(cls, cloud: ImplantPointCloud, number: int) -> Sections:
        """The given number of stations from one end of an implant to the other."""
        _, axes, _ = cloud.principal_axes()
        axis = axes[-1].double()
        points, volumes = cloud.points.double(), cloud.volumes.double()
        height = points @ axis
        low, high = height.aminmax()
        heights = low + (high - low) * torch.linspace(0, 1, number, dtype=torch.float64, device=axis.device)
        without_centers = cls(axis, heights, points.new_zeros(number, 3))
        share = without_centers.weights(points) * volumes[:, None]
        return cls(axis, heights, share.T @ points / share.sum(0)[:, None])

    def weights(self, points: Tensor) -> Tensor:
        """Interpolation weights (N, S) of points (N, 3); rows sum to one. Beyond an end its station has weight one."""
        place = (points.double() @ self.axis - self.heights[0]) / (self.heights[1] - self.heights[0])
        stations = torch.arange(len(self.heights), dtype=place.dtype, device=place.device)
        return (1 - (place.clamp(0, len(self.heights) - 1)[:, None] - stations).abs()).clamp_min(0)

    def motions(self, points: Tensor, volumes: Tensor, fields: Tensor) -> tuple[Tensor, Tensor]:
        """Shifts and small rotations (L, S, 3) of the stations that best fit displacements (L, N, 3) of points (N, 3).

        Shifts are those of the stations' centres.
        """
        shares = self.weights(points) * volumes.double()[:, None]
        shifts, turns = [], []
        for share, center in zip(shares.T, self.centers, strict=True):
            near = share > 0
            arms, weight = points[near].double() - center, share[near] / share[near].sum()
            moved = fields[:, near]
            shift = torch.einsum("p,lpi->li", weight, moved)
            second = torch.einsum("p,pi,pj->ij", weight, arms, arms)
            inertia = second.trace() * torch.eye(3, dtype=second.dtype, device=second.device) - second
            spin = torch.einsum("p,lpi->li", weight, torch.linalg.cross(arms.expand_as(moved), moved))
            shifts.append(shift)
            turns.append(torch.linalg.solve(inertia, spin.mT).mT)
        return torch.stack(shifts, dim=1), torch.stack(turns, dim=1)

    def blended(self, points: Tensor, shifts: Tensor, turns: Tensor) -> Tensor:
        """Displacements (L, N, 3) of points (N, 3), interpolated from small motions (L, S, 3) of the stations."""
        weights = self.weights(points)
        return (
            torch.einsum("ns,lsi->lni", weights, shifts)
            + torch.linalg.cross(
                torch.einsum("ns,lsi->lni", weights, turns), points.double().expand(len(turns), -1, -1), dim=-1
            )
            - torch.einsum("ns,lsi->lni", weights, torch.linalg.cross(turns, self.centers.expand_as(turns), dim=-1))
        )

    def chained(self, shifts: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (K, S, 3, 3) and centres (K, S, 3) of the stations under finite motions.

        Motions of a station relative to its neighbour are small even where the implant has rotated far. The differences
        of the linear motions are therefore taken as strains in the implant's local frame, and are integrated along it
        from the middle station (geometrically exact beam, Simo 1985).

        Args:
            shifts: Linear shifts of the stations, shape (K, S, 3), mm.
            turns: Small rotation vectors of the stations, shape (K, S, 3).
        """
        spans = self.centers.diff(dim=0)
        bends = turns.diff(dim=1)
        between = (turns[:, 1:] + turns[:, :-1]) / 2
        stretched = spans + shifts.diff(dim=1) - torch.linalg.cross(between, spans.expand_as(between), dim=-1)
        whole, half = rotation_from_vector(bends), rotation_from_vector(bends / 2)
        steps = (half @ stretched[..., None])[..., 0]  # from a station to the next, in the frame of the former
        middle = len(self.heights) // 2
        rotations = {middle: rotation_from_vector(turns[:, middle])}
        places = {middle: self.centers[middle] + shifts[:, middle]}
        for s in range(middle, len(self.heights) - 1):
            rotations[s + 1] = rotations[s] @ whole[:, s]
            places[s + 1] = places[s] + (rotations[s] @ steps[:, s, :, None])[..., 0]
        for s in range(middle, 0, -1):
            rotations[s - 1] = rotations[s] @ whole[:, s - 1].mT
            places[s - 1] = places[s] - (rotations[s - 1] @ steps[:, s - 1, :, None])[..., 0]
        order = range(len(self.heights))
        return torch.stack([rotations[s] for s in order], dim=1), torch.stack([places[s] for s in order], dim=1)

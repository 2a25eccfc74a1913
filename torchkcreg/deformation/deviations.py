"""Uncertainty of a registered implant at every point: displacement fields of one standard deviation each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchkcreg.mechanics.holds import rigid_fields
from torchkcreg.plain import require_keys

_NEAREST = 24
_REACH_MM = 4.0  # decay length of the weights of nodes around a point, beyond the distance of the nearest one
_AT_ONCE = 512
_NEGLIGIBLE = 1e-6  # share of the mean square deviation


class Deviation(NamedTuple):
    """Standard deviations of a position, mm.

    Attributes:
        whole: Root mean square length of the deviation.
        lateral: Perpendicular to the rays, per direction.
        depth: Along the rays.
    """

    whole: float
    lateral: float
    depth: float


@dataclass(frozen=True, eq=False)
class Deviations:
    """Uncorrelated error fields of an implant's position, each scaled to one standard deviation.

    Errors at neighbouring points are correlated. A quantity derived from several points (the motion of a fragment, a
    distance) that is a linear function f of their displacements has the standard deviation `sqrt(sum_r f(d_r)^2)`,
    where d_r is the r-th field.

    Attributes:
        points: Nodes (N, 3) of the undeformed implant, in its frame, mm.
        fields: Errors of the nodes in the world, (R, N, 3), mm.
        depth: Direction (3,) in the world that the views determine least: along their rays.
    """

    points: Tensor
    fields: Tensor
    depth: Tensor

    @classmethod
    def of(cls, points: Tensor, slopes: Tensor, covariance: Tensor, depth: Tensor) -> Deviations:
        """Error fields from the covariance of parameters that move the nodes.

        Args:
            points: Nodes (N, 3).
            slopes: Derivatives (D, N, 3) of the nodes' world positions with respect to D parameters.
            covariance: Covariance (D, D) of the parameters.
            depth: Direction (3,) in the world along the rays.
        """
        values, directions = torch.linalg.eigh(covariance)
        fields = torch.einsum("dr,dni->rni", directions * values.clamp_min(0).sqrt(), slopes)
        size = fields.square().sum((1, 2))
        return cls(points, fields[size > _NEGLIGIBLE * size.sum()], depth)

    def at(self, points: Tensor) -> Tensor:
        """The fields (R, P, 3) at points (P, 3) in the undeformed implant's frame.

        Beside the implant they are extrapolated rigidly.
        """
        parts = [self._at(chunk) for chunk in points.to(self.points).split(_AT_ONCE)]
        return torch.cat([self.fields[:, :0], *parts], dim=1)

    def _at(self, points: Tensor) -> Tensor:
        distance, near = torch.cdist(points, self.points).topk(min(_NEAREST, len(self.points)), largest=False)
        weights = torch.exp(-0.5 * ((distance - distance[:, :1]) / _REACH_MM).square())
        arms = self.points[near] - points[:, None]
        motions = rigid_fields(arms.flatten(0, 1)).unflatten(1, near.shape).permute(1, 2, 3, 0)  # (P, k, 3, 6)
        weighted = motions * weights[..., None, None]
        normal = torch.einsum("pkim,pkin->pmn", weighted, motions)
        scale = normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
        normal = normal + 1e-9 * scale * torch.eye(6, dtype=normal.dtype, device=normal.device)
        right_side = torch.einsum("pkim,rpki->pmr", weighted, self.fields[:, near])
        return torch.linalg.solve(normal, right_side)[:, :3].permute(2, 0, 1)

    def covariance(self, points: Tensor) -> Tensor:
        """Covariance (P, 3, 3), in the world, of points (P, 3) in the undeformed implant's frame, mm^2."""
        fields = self.at(points)
        return torch.einsum("rpi,rpj->pij", fields, fields)

    def split(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Lateral and depth standard deviations (P,) of points (P, 3), mm.

        The lateral one is the root mean square over both lateral directions.
        """
        return _split(self.at(points), self.depth)

    @property
    def rms(self) -> Deviation:
        """Root mean square over the nodes."""
        lateral, depth = (float(part.square().mean().sqrt()) for part in _split(self.fields, self.depth))
        return Deviation(math.sqrt(2 * lateral**2 + depth**2), lateral, depth)

    def of_nearest(self, points: Tensor) -> Tensor:
        """Root mean square error (P,) of the nearest node to each of many points (P, 3), mm."""
        _, nearest = cKDTree(self.points.cpu().numpy()).query(points.detach().cpu().numpy())
        std = self.fields.square().sum((0, 2)).sqrt()
        return std[torch.from_numpy(nearest).to(std.device)]

    def to(self, device: torch.device | str) -> Deviations:
        """Copy on a device."""
        moved = {name: getattr(self, name).to(device) for name in ("points", "fields", "depth")}
        return replace(self, **moved)

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors; fields in single precision."""
        return {"points": self.points.to(torch.float32), "fields": self.fields.to(torch.float32), "depth": self.depth}

    @classmethod
    def from_dict(cls, content: Any) -> Deviations:
        """Inverse of `to_dict`.

        Raises:
            ValueError: If a key is missing or malformed; the message names it.
        """
        names = ("points", "fields", "depth")
        require_keys(content, names, " of deviations")
        try:
            points, fields, depth = (torch.as_tensor(content[n], dtype=torch.float64, device="cpu") for n in names)
        except (TypeError, ValueError) as error:
            raise ValueError(f"deviations are malformed: {error}") from None
        shapes_fit = points.ndim == 2 and points.shape[1:] == depth.shape == (3,) and fields.shape[1:] == points.shape
        if not shapes_fit or not all(bool(x.isfinite().all()) for x in (points, fields, depth)):
            raise ValueError("deviations must be finite numbers: points (N, 3), fields (R, N, 3), depth (3,)")
        return cls(points, fields, depth)


def depth_direction(sources: Tensor, center: Tensor) -> Tensor:
    """Mean direction (3,) of the rays from sources (V, 3) to a point (3,): principal axis of their directions."""
    rays = torch.nn.functional.normalize(center - sources, dim=-1)
    _, directions = torch.linalg.eigh(rays.T @ rays)
    return directions[:, -1]


def _split(fields: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    along = (fields @ depth).square().sum(0)
    return ((fields.square().sum((0, 2)) - along) / 2).clamp_min(0).sqrt(), along.sqrt()

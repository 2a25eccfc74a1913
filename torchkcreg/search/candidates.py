"""Candidate poses of a rigid body, with their similarity to the images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import principal_axes


@dataclass(frozen=True)
class Body:
    """Nodes of a rigid body about its centre of mass.

    Attributes:
        center: Centre of mass (3,) in the implant's frame, mm, float64.
        points: Nodes (N, 3) relative to it, mm, float64.
        volumes: Volume of each node (N,), mm^3.
        cell: Edge vectors (3, 3) of a node's cell, mm.
    """

    center: Tensor
    points: Tensor
    volumes: Tensor
    cell: Tensor

    @classmethod
    def of(cls, points: Tensor, volumes: Tensor, cell: Tensor) -> Body:
        """Body of nodes (N, 3) in the implant's frame."""
        points, weights = points.double(), volumes.double()
        center = (points * weights[:, None]).sum(0) / weights.sum()
        return cls(center, points - center, volumes, cell)

    @property
    def radius_mm(self) -> float:
        """Root mean square distance of the nodes from the centre."""
        return float(self.points.square().sum(-1).mean().sqrt())

    @property
    def extent_mm(self) -> float:
        """Largest distance of a node from the centre."""
        return float(self.points.norm(dim=-1).max())

    def half_turns(self) -> Tensor:
        """Half turns (3, 3, 3) about the principal axes: poses that images of a nearly symmetric body hardly tell."""
        axes = principal_axes(self.points)[1]
        return 2 * axes[:, :, None] * axes[:, None, :] - torch.eye(3, dtype=axes.dtype, device=axes.device)


@dataclass(frozen=True)
class Candidates:
    """Candidate poses of a body.

    Attributes:
        rotations: Rotations (K, 3, 3) from the implant's frame to the world, float64.
        centers: Positions (K, 3) of the centre of mass in the world, mm, float64.
        similarity: Correlation of gradients on and around the body's shadow, mean over the views, (K,).
    """

    rotations: Tensor
    centers: Tensor
    similarity: Tensor

    def __len__(self) -> int:
        return len(self.rotations)

    def __getitem__(self, index: Tensor | slice) -> Candidates:
        return Candidates(self.rotations[index], self.centers[index], self.similarity[index])

    def __add__(self, other: Candidates) -> Candidates:
        return Candidates(
            torch.cat([self.rotations, other.rotations]),
            torch.cat([self.centers, other.centers]),
            torch.cat([self.similarity, other.similarity]),
        )

    def best(self, number: int) -> Candidates:
        """The `number` most similar ones, best first."""
        return self[self.similarity.argsort(descending=True)[:number]]

    def poses(self, body: Body) -> Tensor:
        """Matrices (K, 4, 4) from the implant's frame to the world."""
        poses = torch.eye(4, dtype=torch.float64, device=self.centers.device).repeat(len(self), 1, 1)
        poses[:, :3, :3] = self.rotations
        poses[:, :3, 3] = self.centers - (self.rotations @ body.center[:, None])[..., 0]
        return poses

    def distinct(self, body: Body, distance_mm: float) -> Candidates:
        """The most similar ones whose nodes lie further apart than this (RMS), best first."""
        ordered = self.best(len(self))
        second_moment = body.points.mT @ body.points / len(body.points)
        turns = ordered.rotations[:, None] - ordered.rotations[None]
        spread = torch.einsum("abij,jk,abik->ab", turns, second_moment, turns)
        apart = spread + (ordered.centers[:, None] - ordered.centers[None]).square().sum(-1) > distance_mm**2
        kept: list[int] = []
        for index in range(len(ordered)):
            if bool(apart[index, kept].all()):
                kept.append(index)
        return ordered[torch.tensor(kept, dtype=torch.long, device=self.centers.device)]

    def half_turned(self, body: Body) -> Candidates:
        """For each, three candidates turned by half a turn about a principal axis, of unknown similarity."""
        turned = (self.rotations[:, None] @ body.half_turns()).flatten(0, 1)
        return Candidates(turned, self.centers.repeat_interleave(3, 0), self.similarity.new_zeros(len(turned)))

    def about(self, shift: Tensor) -> Candidates:
        """The same poses, with centres for a centre of mass moved by `shift` (3,) in the implant's frame."""
        return Candidates(self.rotations, self.centers + self.rotations @ shift, self.similarity)

"""Where an assembly goes with a motion: what its points need to know of it, computed once."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.deformation import Motion, combined
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points

from .assembly import Assembly
from .state import Placement


class BoundMotion:
    """Placements of an assembly as a function of the steps of its motion.

    Args:
        assembly: In its present state.
        motion: Of its deformation from there.
        nodes: The implant's nodes (N, 3) that are rendered.
    """

    def __init__(self, assembly: Assembly, motion: Motion, nodes: Tensor) -> None:
        self.motion, self.pose = motion, assembly.implant_to_world.clone()
        self.turns = rotation_about(assembly.heads, assembly.tilts)
        self.nodes = self._bound(nodes.double(), nodes.dtype)
        self.at_rest = assembly.followed
        self.followed = self._bound(assembly.followed.flatten(0, 1), torch.float64) if len(assembly.followed) else None

    def _bound(self, points: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """World positions (N, 3) of points at rest, and their features (N, F)."""
        return transform_points(self.pose, points).to(dtype), self.motion.features(points).to(dtype)

    def __call__(self, steps: Tensor, component_motions: Tensor | None = None) -> Placement:
        """Placements of steps (K, D).

        Args:
            steps: Of the motion.
            component_motions: Motions (K, C, 4, 4) of the components in the implant's frame beside following it; those
                that they have now when None.
        """
        coefficients = self.motion.coefficients(steps) @ self.pose[:3, :3].T
        turns = self.turns if component_motions is None else component_motions
        components = self.pose.new_zeros(len(steps), 0, 4, 4)
        if self.followed is not None:
            moved = _moved(self.followed, coefficients).unflatten(1, self.at_rest.shape[:2])
            components = fit_rigid(self.at_rest, moved) @ turns
        return Placement(_moved(self.nodes, coefficients), components)


def _moved(bound: tuple[Tensor, Tensor], coefficients: Tensor) -> Tensor:
    """World positions (K, N, 3) for coefficients (K, F, 3) in the world's axes."""
    world, features = bound
    return world + combined(features, coefficients.to(features))

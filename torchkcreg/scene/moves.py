"""Parameters of a stage as named blocks of one vector, and the scene states they lead to."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.deformation import Level, Motion, combined
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points
from torchkcreg.implant import Screw
from torchkcreg.optimization.parameters import ParameterBlock, ParameterBlocks

from .assembly import Assembly
from .parameter_blocks import ComponentTilts, PhysicsParameters, ScrewShapes
from .scene import Scene
from .state import Placement, State
from .view import View
from .view_motions import ViewMotionSteps

_PITCH_MM = 0.5
_DIFFERENCE_MM = 1e-3
_NODES_PITCH_MM = 2.0  # distances between candidates need no finer nodes
_DEVIATIONS_PITCH_MM = 3.0


class BoundMotion:
    """Placements of an assembly as a function of the steps of its motion.

    Args:
        assembly: Assembly in its present state.
        motion: Motion of its deformation from there.
        nodes: Rendered nodes (N, 3) of the implant.
    """

    def __init__(self, assembly: Assembly, motion: Motion, nodes: Tensor) -> None:
        self.motion, self.pose = motion, assembly.implant_to_world.detach()
        self.turns = rotation_about(assembly.heads, assembly.tilts)
        self.nodes = self._bound(nodes.double(), nodes.dtype)
        self.at_rest = assembly.followed
        self.followed = self._bound(assembly.followed.flatten(0, 1), torch.float64) if len(assembly.followed) else None

    def _bound(self, points: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """World positions (N, 3) of points at rest, and their features (N, F)."""
        return transform_points(self.pose, points).to(dtype), self.motion.features(points).to(dtype)

    def __call__(self, steps: Tensor, component_motions: Tensor | None = None) -> Placement:
        """Placements for steps (K, D).

        Args:
            steps: Steps of the motion.
            component_motions: Motions (K, C, 4, 4) of the components in the implant's frame, in addition to following
                it; their present tilts when None.
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


class ScrewPaths:
    """Path lengths (V, rows, cols), mm, of screws moved with an assembly in its present state.

    Args:
        assembly: Assembly; it must not move while this is used.
        view: View that contains it.
    """

    def __init__(self, assembly: Assembly, view: View) -> None:
        self.assembly, self.view = assembly, view
        self._motions: dict[tuple[float, float, float], Tensor] = {}

    @torch.no_grad()
    def __call__(self, screw: Screw) -> Tensor:
        """Path lengths of a screw given in the implant's frame."""
        pose = self.assembly.implant_to_world
        if screw.start not in self._motions:
            self._motions[screw.start] = pose @ self.assembly.motion_at(pose.new_tensor(screw.start))
        return self.view.cloud_path_lengths(screw.stretched_cloud(_PITCH_MM), self._motions[screw.start])


class Moves(ParameterBlocks):
    """Parameters of a stage: changes of a scene from its present state, in mm or scaled like mm.

    Args:
        scene: Scene in its present state.
        view: View of the scene.
        level: Fineness of the deformations.
        estimate: Parameters of the intensity model to estimate.
        screws: Estimate lengths and radii of found screws.
        tilts: Estimate small rotations of components about their heads.
        views: Estimate motions of views, if the scene has them.
        prior_weight: Loss for one standard deviation of a parameter of the intensity model or of a tilt.
    """

    def __init__(
        self,
        scene: Scene,
        view: View,
        level: Level,
        *,
        estimate: Sequence[str] = (),
        screws: bool = False,
        tilts: bool = False,
        views: bool = False,
        prior_weight: float = 0.0,
    ) -> None:
        self.scene, self.view = scene, view
        blocks: dict[str, ParameterBlock] = {}
        self.parts = [_Part(assembly, view, nodes, level) for assembly, nodes in zip(scene, view.nodes, strict=True)]
        for part in self.parts:
            blocks[f"motion of {part.name}"] = part.bound.motion
        self.physics = PhysicsParameters(scene.intensity, estimate, view.pixel_px, prior_weight)
        blocks["physics"] = self.physics
        for part in self.parts:
            if screws and part.assembly.found:
                part.shapes = part.screw_shapes(view)
                blocks[f"screws of {part.name}"] = part.shapes
            if tilts and len(part.assembly.components):
                part.tilts = ComponentTilts(part.assembly, prior_weight)
                blocks[f"tilts of {part.name}"] = part.tilts
        self.views = None
        if views and scene.view_motions is not None:
            self.views = blocks["views"] = ViewMotionSteps(scene.view_motions)
        super().__init__(blocks)

    def seen_in(self, view: View) -> Moves:
        """The same parameters, rendered in another view of the same scene."""
        copied = copy.copy(self)
        copied.view, copied._blocks = view, dict(self._blocks)
        copied.physics = copied._blocks["physics"] = self.physics.on_pixels(view.pixel_px)
        copied.parts = [part.seen_in(view, nodes) for part, nodes in zip(self.parts, view.nodes, strict=True)]
        for part in copied.parts:
            if part.shapes:
                copied._blocks[f"screws of {part.name}"] = part.shapes
        return copied

    def state(self, parameters: Tensor) -> State:
        """Candidate states of the scene for parameters (K, D)."""
        steps = self.split(parameters)
        added: dict[str, Tensor] = {}
        placements = []
        for part in self.parts:
            turns = part.tilts.motions(steps[f"tilts of {part.name}"]) if part.tilts else None
            placements.append(part.bound(steps[f"motion of {part.name}"], turns))
            if part.shapes:
                for name, path in part.shapes.added(steps[f"screws of {part.name}"]).items():
                    added[name] = path if name not in added else added[name] + path
        views = None if self.views is None else self.views.motions(steps["views"])
        return State(tuple(placements), self.physics.arguments(steps["physics"]), added, views)

    def displacements(self, parameters: Tensor) -> Tensor:
        """Displacements (K, S) of all nodes, weighted so that their squares sum to the mean square, mm^2."""
        steps = self.split(parameters)
        return (
            torch.cat([part.displacements(steps[f"motion of {part.name}"]) for part in self.parts], dim=-1)
            / len(self.parts) ** 0.5
        )

    @torch.no_grad()
    def shift(self, number: int, direction: Tensor) -> Tensor:
        """Step (D,) that shifts assembly `number` by 1 mm along a direction (3,) of its implant's frame."""
        part, name, direction = self.parts[number], f"motion of {self.parts[number].name}", direction.double()
        offsets = _DIFFERENCE_MM * torch.eye(self[name].num_parameters, dtype=torch.float64, device=direction.device)
        slopes = (part.displacements(offsets) - part.displacements(-offsets)) / (2 * _DIFFERENCE_MM)
        shifted = (part.share * direction).flatten()
        steps = {name: block.at_rest(direction.device)[0] for name, block in self.items()}
        steps[name] = torch.linalg.lstsq(slopes.T, shifted[:, None]).solution[:, 0]
        return torch.cat(list(steps.values()))

    @torch.no_grad()
    def slopes(self, number: int) -> tuple[Tensor, Tensor]:
        """Nodes (N, 3) of assembly `number` and their derivatives (D, N, 3) by the steps of its motion.

        Derivatives are taken at rest, in the world's axes.
        """
        motion, pose = self.parts[number].bound.motion, self.parts[number].bound.pose
        points = self.parts[number].assembly.implant.coarsened_to(_DEVIATIONS_PITCH_MM).points.double()
        offsets = _DIFFERENCE_MM * torch.eye(motion.num_parameters, dtype=torch.float64, device=points.device)
        change = motion.coefficients(offsets) - motion.coefficients(-offsets)
        return points, motion.features(points) @ (change / (2 * _DIFFERENCE_MM)) @ pose[:3, :3].mT

    def keep_covariance(self, covariance: Tensor) -> list[Tensor]:
        """Pass to each motion its block of the covariance (D, D) of all parameters; return these blocks."""
        places = [self.places[f"motion of {part.name}"] for part in self.parts]
        covariances = [covariance[place, place] for place in places]
        for part, block in zip(self.parts, covariances, strict=True):
            part.bound.motion.keep_covariance(block)
        return covariances

    @torch.no_grad()
    def accept(self, parameters: Tensor) -> None:
        """Move the scene to parameters (D,); rigid parts of the deformations are moved into the poses."""
        steps = self.split(parameters)
        for part in self.parts:
            part.accept(steps)
        self.physics.accept(steps["physics"])
        if self.views is not None:
            self.views.accept(steps["views"])


class _Part:
    """Parameters of one assembly in a stage."""

    def __init__(self, assembly: Assembly, view: View, nodes: Tensor, level: Level) -> None:
        self.assembly, self.name = assembly, assembly.name
        assembly.deformation.fixed_at(assembly.heads)
        self.bound = BoundMotion(assembly, assembly.deformation.motion(assembly.implant, level), nodes)
        self.shapes: ScrewShapes | None = None
        self.tilts: ComponentTilts | None = None
        coarse = assembly.implant.coarsened_to(_NODES_PITCH_MM)
        self.share = (coarse.volumes.double() / coarse.volumes.double().sum()).sqrt()[:, None]
        self.features = self.bound.motion.features(coarse.points)

    def screw_shapes(self, view: View) -> ScrewShapes:
        """Parameters of the found screws' lengths and radii in a view."""
        return ScrewShapes(self.assembly.found, ScrewPaths(self.assembly, view))

    def seen_in(self, view: View, nodes: Tensor) -> _Part:
        """The same parameters with other rendered nodes."""
        other = copy.copy(self)
        other.bound = BoundMotion(self.assembly, self.bound.motion, nodes)
        other.shapes = self.screw_shapes(view) if self.shapes else None
        return other

    def displacements(self, steps: Tensor) -> Tensor:
        """Displacements (K, 3 N) of the nodes, weighted."""
        return (combined(self.features, self.bound.motion.coefficients(steps)) * self.share).flatten(1)

    def accept(self, steps: dict[str, Tensor]) -> None:
        """Move the assembly by the steps."""
        assembly = self.assembly
        common = self.bound.motion.accept(steps[f"motion of {self.name}"])
        assembly.implant_to_world = assembly.implant_to_world @ common
        if self.tilts:
            assembly.tilts = self.tilts.vectors(steps[f"tilts of {self.name}"]).clone()
        if assembly.found and (self.shapes or self.tilts):
            screws = self.shapes.stepped(steps[f"screws of {self.name}"]) if self.shapes else assembly.found
            still = torch.zeros_like(assembly.tilts)
            shifts = self.tilts.shifts(steps[f"tilts of {self.name}"]) if self.tilts else still
            assembly.place([s.moved(*by) for s, *by in zip(screws, assembly.tilts, shifts, strict=True)])

"""All that a stage may change in a scene, as named blocks of one vector of parameters."""

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


class ScrewPaths:
    """Path lengths (V, rows, cols) in mm of screws where an assembly, as it is, would have them.

    Args:
        assembly: It must not move meanwhile.
        view: Of it.
    """

    def __init__(self, assembly: Assembly, view: View) -> None:
        self.assembly, self.view = assembly, view
        self._motions: dict[tuple[float, float, float], Tensor] = {}

    @torch.no_grad()
    def __call__(self, screw: Screw) -> Tensor:
        """Of a screw, given in the implant's frame."""
        pose = self.assembly.implant_to_world
        if screw.start not in self._motions:
            self._motions[screw.start] = pose @ self.assembly.motion_at(pose.new_tensor(screw.start))
        return self.view.cloud_path_lengths(screw.stretched_cloud(_PITCH_MM), self._motions[screw.start])


class Moves(ParameterBlocks):
    """What a stage may change in a scene: increments to its state when they are made, in mm or worth as much.

    Args:
        scene: In its present state.
        view: Of it.
        level: How finely deformations move.
        estimate: Parameters of the intensity model that are estimated along.
        screws: Lengths and radii of found screws are, too.
        tilts: Components may turn a little about their heads.
        views: Views may move, if the scene has motions of views.
        prior_weight: Loss for a parameter of the intensity model, or a tilt, that is a standard deviation off.
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
        """The same moves, with the same parameters, as another view of the same scene shows them."""
        other = copy.copy(self)
        other.view, other._blocks = view, dict(self._blocks)
        other.physics = other._blocks["physics"] = self.physics.on_pixels(view.pixel_px)
        other.parts = [part.seen_in(view, nodes) for part, nodes in zip(self.parts, view.nodes, strict=True)]
        for part in other.parts:
            if part.shapes:
                other._blocks[f"screws of {part.name}"] = part.shapes
        return other

    def state(self, parameters: Tensor) -> State:
        """The scene's candidates with parameters (K, D)."""
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
        """Displacements (K, S) of all implants' nodes, so weighted that their squares sum to the mean square, mm^2."""
        steps = self.split(parameters)
        return (
            torch.cat([part.displacements(steps[f"motion of {part.name}"]) for part in self.parts], dim=-1)
            / len(self.parts) ** 0.5
        )

    @torch.no_grad()
    def shift(self, number: int, direction: Tensor) -> Tensor:
        """The step (D,) that shifts an assembly, by its number, by 1 mm along a direction (3,) of its own frame."""
        part, name, direction = self.parts[number], f"motion of {self.parts[number].name}", direction.double()
        offsets = _DIFFERENCE_MM * torch.eye(self[name].num_parameters, dtype=torch.float64, device=direction.device)
        slopes = (part.displacements(offsets) - part.displacements(-offsets)) / (2 * _DIFFERENCE_MM)
        wanted = (part.share * direction).flatten()
        steps = {name: block.at_rest(direction.device)[0] for name, block in self.items()}
        steps[name] = torch.linalg.lstsq(slopes.T, wanted[:, None]).solution[:, 0]
        return torch.cat(list(steps.values()))

    @torch.no_grad()
    def slopes(self, number: int) -> tuple[Tensor, Tensor]:
        """Nodes (N, 3) of an assembly, by its number, and how far a unit of each step of its motion moves them.

        Steps from rest, in the world's axes: (D, N, 3).
        """
        motion, pose = self.parts[number].bound.motion, self.parts[number].bound.pose
        points = self.parts[number].assembly.implant.coarsened_to(_DEVIATIONS_PITCH_MM).points.double()
        offsets = _DIFFERENCE_MM * torch.eye(motion.num_parameters, dtype=torch.float64, device=points.device)
        change = motion.coefficients(offsets) - motion.coefficients(-offsets)
        return points, motion.features(points) @ (change / (2 * _DIFFERENCE_MM)) @ pose[:3, :3].mT

    def keep_covariance(self, covariance: Tensor) -> list[Tensor]:
        """Tells each motion the covariance of its steps, out of that of all parameters (D, D), and returns them."""
        places = [self.places[f"motion of {part.name}"] for part in self.parts]
        own = [covariance[place, place] for place in places]
        for part, known in zip(self.parts, own, strict=True):
            part.bound.motion.keep_covariance(known)
        return own

    @torch.no_grad()
    def accept(self, parameters: Tensor) -> None:
        """Moves the scene to parameters (D,); common rigid motions go from the deformations into the poses."""
        steps = self.split(parameters)
        for part in self.parts:
            part.accept(steps)
        self.physics.accept(steps["physics"])
        if self.views is not None:
            self.views.accept(steps["views"])


class _Part:
    """What a stage may change of one assembly."""

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
        """How the found screws' lengths and radii change the images of a view."""
        return ScrewShapes(self.assembly.found, ScrewPaths(self.assembly, view))

    def seen_in(self, view: View, nodes: Tensor) -> _Part:
        """The same, with other nodes that are rendered."""
        other = copy.copy(self)
        other.bound = BoundMotion(self.assembly, self.bound.motion, nodes)
        other.shapes = self.screw_shapes(view) if self.shapes else None
        return other

    def displacements(self, steps: Tensor) -> Tensor:
        """Displacements (K, 3 N) of the nodes, weighted."""
        return (combined(self.features, self.bound.motion.coefficients(steps)) * self.share).flatten(1)

    def accept(self, steps: dict[str, Tensor]) -> None:
        """Moves the assembly."""
        assembly = self.assembly
        common = self.bound.motion.accept(steps[f"motion of {self.name}"])
        assembly.implant_to_world.copy_(assembly.implant_to_world @ common)
        if self.tilts:
            assembly.tilts = self.tilts.vectors(steps[f"tilts of {self.name}"]).clone()
        if assembly.found and (self.shapes or self.tilts):
            screws = self.shapes.stepped(steps[f"screws of {self.name}"]) if self.shapes else assembly.found
            still = torch.zeros_like(assembly.tilts)
            shifts = self.tilts.shifts(steps[f"tilts of {self.name}"]) if self.tilts else still
            assembly.place([s.moved(*by) for s, *by in zip(screws, assembly.tilts, shifts, strict=True)])

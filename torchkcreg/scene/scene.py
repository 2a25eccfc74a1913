"""A scene of implants that renders its own X-ray images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.physics import IdentityIntensity, IntensityModel

from .assembly import Assembly
from .data import RegistrationData
from .state import State
from .view import View
from .view_motions import ViewMotions


class Scene(nn.Module):
    """Implants with their poses, deformations and components, and the intensity model.

    Calling it with a geometry gives the line integrals of the geometry's views, differentiable in all parameters of the
    scene.

    A candidate is one set of trial poses, deformations and parameters; K of them are rendered in one batch.

    Args:
        assemblies: One implant or several, each with what is fixed to it.
        intensity: Maps path lengths of the materials, in the order of `materials`, to line integrals.
        metals: Possible materials of screws found in the implants' holes, besides the implants' own.
        materials: Names in the order of the path lengths; those of implants, metals and components when None.
        backend: Projector: "auto", "cpp", "triton" or "torch".

    Attributes:
        view_motions: Motion of the scene in each measured view relative to the geometry; None: no motion.

    >>> import trimesh
    >>> from torchkcreg.deformation import RigidDeformation
    >>> from torchkcreg.geometry import circular_geometry
    >>> from torchkcreg.implant import ImplantPointCloud
    >>> cube = ImplantPointCloud.from_mesh(trimesh.creation.box((10.0, 10.0, 10.0)), pitch=0.5)
    >>> views = circular_geometry([0, 90], sad=404, sdd=538, det_shape=(32, 32), pixel_spacing=(1.0, 1.0))
    >>> scene = Scene([Assembly(cube, RigidDeformation())])
    >>> round(scene(views).amax().item(), 1)
    10.0
    """

    assemblies: Sequence[Assembly]
    intensity: IntensityModel
    materials: list[str]

    def __init__(
        self,
        assemblies: Sequence[Assembly],
        intensity: IntensityModel | None = None,
        *,
        metals: Sequence[str] = (),
        materials: Sequence[str] | None = None,
        backend: str = "auto",
    ) -> None:
        super().__init__()
        if not assemblies:
            raise ValueError("a scene needs at least one implant, got none")
        names = [assembly.name for assembly in assemblies]
        if len(set(names)) < len(names):
            raise ValueError(f"implants must have names of their own, got {', '.join(names)}")
        self.assemblies = nn.ModuleList(assemblies)  # type: ignore[assignment]
        self.intensity = IdentityIntensity() if intensity is None else intensity
        self.view_motions: ViewMotions | None = None
        self.metals, self.backend = list(metals), backend
        implant_materials = [a.material for a in assemblies]
        parts = [c.material for a in assemblies for c in a.components]
        self.materials = (
            list(dict.fromkeys([*implant_materials, *metals, *parts])) if materials is None else list(materials)
        )
        if missing := {*implant_materials, *metals, *parts} - set(self.materials):
            raise ValueError(f"materials must hold all that the scene is made of, got none of {', '.join(missing)}")

    def __iter__(self) -> Iterator[Assembly]:
        return iter(self.assemblies)

    def view(self, data: RegistrationData | ConeBeamGeometry, **scale: Any) -> View:
        """View of the scene near its present state; see `View` for `scale`.

        With measured images the geometry is corrected by the view motions; a geometry alone is used unchanged.
        """
        if self.view_motions is not None and isinstance(data, RegistrationData):
            data = replace(data, geometry=self.view_motions.corrected(data.geometry))
        return View(list(self.assemblies), self.materials, data, backend=self.backend, **scale)

    def state(self, view: View) -> State:
        """The scene's present state, as one candidate."""
        placements = [a.placement(nodes) for a, nodes in zip(self.assemblies, view.nodes, strict=True)]
        physics = {
            free.attribute: getattr(self.intensity, free.attribute)[None] for free in self.intensity.free.values()
        }
        return State(tuple(placements), self.intensity.arguments(view.pixel_px, **physics))

    def path_lengths(self, view: View | ConeBeamGeometry, state: State | None = None) -> Tensor:
        """Path lengths (K, M, V, rows, cols) on the view's rendered pixels, mm; K is 1 for the present state.

        If the intensity model has a background, it is the last material.
        """
        view = self.view(view) if isinstance(view, ConeBeamGeometry) else view
        state = self.state(view) if state is None else state
        paths = view.path_lengths(state.placements, len(self.materials), state.views)
        for name, added in state.added.items():
            index = self.materials.index(name)
            paths[index] = paths[index] + added
        if self.intensity.has_background:
            unknown = view.matrices.new_zeros(()) if view.background is None else view.background
            paths.append(unknown.expand(paths[0].shape))
        return torch.stack(paths, dim=-4)

    def forward(self, view: View | ConeBeamGeometry, state: State | None = None) -> Tensor:
        """Line integrals (K, V, rows, cols) of candidates, or (V, rows, cols) of the present state.

        Args:
            view: See `view`; or a geometry, rendered whole.
            state: Candidates; the present state when None.
        """
        view = self.view(view) if isinstance(view, ConeBeamGeometry) else view
        candidates = self.state(view) if state is None else state
        paths, physics = self.path_lengths(view, candidates), self.arguments(view, candidates)
        lines = self.intensity(paths, pooling=view.oversampling, **physics)
        if view.following is not None and self.intensity.has_background:
            levels = torch.stack([physics["scatter"], physics["scatter_removed"]], dim=-1)
            lines = view.following(lines, levels)
        return lines[0] if state is None else lines

    def arguments(self, view: View, state: State) -> dict[str, Any]:
        """Keyword arguments of the intensity model for the candidates in a view."""
        physics = dict(state.physics)
        if view.data is not None and view.data.scatter_shapes is not None and self.intensity.has_background:
            physics["scatter_shapes"] = view.data.scatter_shapes
        return physics | self.intensity.of_sources(view.geometry.sources)

    def with_only(self, assemblies: Sequence[Assembly]) -> Scene:
        """A scene of some of the implants; assemblies and intensity model are shared, not copied."""
        chosen = list(assemblies)
        return Scene(chosen, self.intensity, metals=self.metals, materials=self.materials, backend=self.backend)

    def without_components(self, assembly: Assembly) -> Scene:
        """The scene with one implant stripped of its components; all else is shared."""
        return self.with_only([a.bare() if a is assembly else a for a in self.assemblies])

    def kept(self) -> dict[str, Any]:
        """Copy of all that a registration changes, as tensors and plain types, for `restore` and checkpoints."""
        return {
            "assemblies": [assembly.kept() for assembly in self.assemblies],
            "intensity": {name: value.detach().clone() for name, value in self.intensity.named_parameters()},
            "view_motions": None if self.view_motions is None else self.view_motions.kept(),
        }

    @torch.no_grad()
    def restore(self, kept: dict[str, Any]) -> None:
        """Restore a state that `kept` returned."""
        for assembly, state in zip(self.assemblies, kept["assemblies"], strict=True):
            assembly.restore(state)
        for name, value in self.intensity.named_parameters():
            value.copy_(kept["intensity"][name])
        views = kept.get("view_motions")
        self.view_motions = None if views is None else ViewMotions.of_kept(views)

    def description(self) -> dict[str, list[float]]:
        """Numbers that identify the scene, to check that a checkpoint belongs to it."""
        numbers_of: dict[str, list[float]] = {"the intensity model": [len(list(self.intensity.parameters()))]}
        for assembly in self.assemblies:
            named = "" if len(self.assemblies) == 1 else f" of {assembly.name}"
            numbers_of |= {f"{text}{named}": numbers for text, numbers in assembly.description().items()}
        return numbers_of

"""The outcome of a registration."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import Deformation
from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import KnownComponent, Screw
from torchkcreg.physics import Beam, PolyenergeticTransmission, scattered_signal
from torchkcreg.plain import finite_array, finite_number, first_line, require_keys
from torchkcreg.scene import RegistrationData, Scene, scene_from_dict, scene_to_dict

from .config import RegistrationConfig
from .registered_implant import RegisteredImplant
from .verdict import Status

FORMAT = "torchkcreg deformation"
FORMAT_VERSION = 2


def upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Convert plain data of format version 1 (one implant, other stages) to version 2.

    Raises:
        ValueError: If a key is missing.
    """
    of_implant = ("implant_to_world", "components", "grid", "control_points_mm", "labels", "screws_found")
    require_keys(content, ("implant_to_world", "grid", "control_points_mm", "labels", "gc", "config"))
    screws = [{**screw, "name": f"found{i}"} for i, screw in enumerate(content.get("screws_found", []))]
    implant = {
        "implant_to_world": content["implant_to_world"],
        "material": content["config"].get("material"),
        "deformation": {"model": "ffd", **{key: content[key] for key in ("grid", "control_points_mm", "labels")}},
        "components": content.get("components", {}),
        "screws": screws,
        "found": [screw["name"] for screw in screws],
    }
    options = {key: value for key, value in content["config"].items() if key != "stages"}
    rest = {key: value for key, value in content.items() if key not in of_implant}
    return {**rest, "format_version": 2, "implants": [implant], "config": options}


class RegisteredImplants:
    """Methods of a set of registered implants; `RegistrationResult` holds them."""

    implants: list[RegisteredImplant]

    def implant(self, name: str | None = None) -> RegisteredImplant:
        """The implant of this name; the first one if None.

        Raises:
            ValueError: If there is none of that name.
        """
        matching = [i for i in self.implants if name in (None, i.name)]
        if not matching:
            raise ValueError(f"no implant {name!r}: there are {', '.join(i.name for i in self.implants)}")
        return matching[0]

    @property
    def implant_to_world(self) -> Tensor:
        """Of the first implant."""
        return self.implants[0].implant_to_world

    @property
    def deformation(self) -> Deformation:
        """Of the first implant."""
        return self.implants[0].deformation

    @property
    def screws_found(self) -> list[Screw]:
        """Screws that were found, not given, each in its implant's frame before the motion."""
        return [screw for implant in self.implants for screw in implant.screws if screw.name in implant.found]

    def warp(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """World positions (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in float64.

        Points beyond the control-point grid move rigidly with the nearest group; `outside` flags them.
        """
        return self.implant(implant).warp(points)

    def displacement(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """Bending u (..., 3), mm, of points (..., 3) of the undeformed implant's frame, in that frame."""
        return self.implant(implant).displacement(points)

    def outside(self, points: Tensor, *, implant: str | None = None) -> Tensor:
        """True for points (..., 3) beyond the valid domain of the control-point grid."""
        return self.implant(implant).outside(points)

    def deformed(
        self, mesh: trimesh.Trimesh, *, implant: str | None = None, longest_edge_mm: float = 4.0
    ) -> trimesh.Trimesh:
        """A mesh of the undeformed implant's frame, bent and in its place in the world; long edges are split first."""
        return self.implant(implant).deformed(mesh, longest_edge_mm=longest_edge_mm)

    def known_components(
        self, meshes: trimesh.Trimesh | Mapping[str, trimesh.Trimesh] | None = None, *, pitch: float = 0.25
    ) -> list[KnownComponent]:
        """The bent implants and their screws as known components in the world, for KC-Rec.

        Args:
            meshes: Mesh of the undeformed implant, or one per name; makes masks exact. If None, registered nodes are
                used.
            pitch: Pitch of the nodes made from meshes, mm.

        Raises:
            ValueError: If an implant's material is unknown, or there are neither mesh nor nodes.
        """
        named = {self.implants[0].name: meshes} if isinstance(meshes, trimesh.Trimesh) else dict(meshes or {})
        return [part for i in self.implants for part in i.known_components(named.get(i.name), pitch=pitch)]


@dataclass
class RegistrationResult(RegisteredImplants):
    """Result of a registration.

    Attributes:
        implants: The registered implants; `warp` and similar methods use the first one if no name is given.
        gc: Gradient correlation of each view at the end, shape (V,).
        history: One record an iteration: stage, iteration, loss, step_mm, seconds.
        config: Options of the registration.
        seed: Seed of the random numbers.
        status: "ok", "doubtful" or "failed": whether the result can be trusted, for the reasons in `warnings`.
        warnings: Reasons for caution, in words.
        diagnostics: Measures behind the verdict, see `Diagnostics`; `node_std_mm` is the expected root mean square
            error of the implant's nodes.
        searched: Names of the implants whose start pose was searched.
        stages: One record a stage: iterations, converged, loss, undone.
        intensity: Estimated parameters of the intensity model.
        blur_mm: Standard deviation of the system's blur on the detector; 0 if not modelled.
        view_motions: Estimated rigid motions (V, 4, 4) of the world before projection in each view, `P_v T_v`; None
            if the geometry was kept.
        scene: The registered scene; None if the result was read from a run folder.
    """

    implants: list[RegisteredImplant]
    gc: Tensor
    history: list[dict[str, Any]]
    config: RegistrationConfig
    seed: int = 0
    status: Status = "ok"
    warnings: list[str] = field(default_factory=list)
    diagnostics: dict[str, Any] = field(default_factory=dict)
    searched: tuple[str, ...] = ()
    stages: list[dict[str, Any]] = field(default_factory=list)
    intensity: dict[str, float] = field(default_factory=dict)
    blur_mm: float = 0.0
    view_motions: Tensor | None = None
    scene: Scene | None = field(default=None, repr=False)

    def corrected(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """The geometry corrected by the estimated view motions; unchanged if there are none."""
        return geometry if self.view_motions is None else geometry.moved(self.view_motions)

    @torch.no_grad()
    def project(self, geometry: ConeBeamGeometry) -> Tensor:
        """Line integrals (V, rows, cols) of the registered implants and their components in any views.

        Raises:
            ValueError: If the result was read from a run folder, which does not keep the implants' nodes.
        """
        return self._scene()(geometry)

    def beam(self) -> Beam:
        """Beam with the estimated hardness and the attenuation of the known components.

        Raises:
            ValueError: If DRRs were plain path lengths, or the result has no scene.
        """
        model = self._scene().intensity
        if not isinstance(model, PolyenergeticTransmission) or model.beam.sources is not None:
            raise ValueError("the registration had no beam of one spectrum: name the implant's material")
        names = [name for i in self.implants for name in (i.material, *(screw.material for screw in i.screws))]
        rows = [model.material_names.index(name) for name in dict.fromkeys(names) if name is not None]
        return model.beam.behind(float(model.hardness.detach()), rows)

    @torch.no_grad()
    def scatter(self, transmission: Tensor, geometry: ConeBeamGeometry, *, mask: Tensor | None = None) -> Tensor:
        """Estimated scatter (V, rows, cols) in any views of the scan, in units of the open beam.

        Args:
            transmission: Measured intensity over the open beam's, shape (V, rows, cols).
            geometry: The views.
            mask: 0 where a pixel holds no measurement.
        """
        data = RegistrationData.of_transmission(geometry, transmission, mask)
        levels = transmission.new_tensor([[self.intensity.get(name, 0.0) for name in ("scatter", "scatter_removed")]])
        return scattered_signal(levels, data.with_scatter_shapes(self.config.scatter_mm).scatter_shapes)[0]

    def known(
        self,
        transmission: Tensor,
        geometry: ConeBeamGeometry,
        meshes: trimesh.Trimesh | Mapping[str, trimesh.Trimesh] | None = None,
        *,
        mask: Tensor | None = None,
    ) -> dict[str, Any]:
        """Arguments of `reconstruct` that a reconstruction of the whole scan takes from the registration.

        Estimated beam, components, scatter and blur:
        `reconstruct(transmission, geometry, grid, **result.known(transmission, geometry, mesh))`.

        Args:
            transmission: Measured intensity over the open beam's, shape (V, rows, cols), of all views.
            geometry: The views.
            meshes: See `known_components`.
            mask: 0 where a pixel holds no measurement.

        Raises:
            ValueError: As `beam` and `known_components` do.
        """
        return {
            "beam": self.beam(),
            "components": self.known_components(meshes),
            "scatter": self.scatter(transmission, geometry, mask=mask),
            "mask": mask,
            "blur_sigma_px": self.blur_mm / math.sqrt(geometry.pixel_spacing[0] * geometry.pixel_spacing[1]),
        }

    def to(self, device: torch.device | str) -> RegistrationResult:
        """The result, moved to a device."""
        if self.scene is not None:
            self.scene.to(device)
        self.gc, self.implants = self.gc.to(device), [implant.to(device) for implant in self.implants]
        self.view_motions = None if self.view_motions is None else self.view_motions.to(device)
        return self

    def _scene(self) -> Scene:
        if self.scene is None:
            raise ValueError("the result was read from a run folder, which keeps no nodes of the implants; save() does")
        return self.scene

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result with its scene, for `load`.

        Raises:
            ValueError: If a parameter is not finite, or the result has no scene.
        """
        content = {"result": self.to_dict(), "history": self.history, "scene": scene_to_dict(self._scene())}
        temporary = f"{os.fspath(path)}.part"
        torch.save(content, temporary)
        os.replace(temporary, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> RegistrationResult:
        """Read a file that `save` wrote; no code in the file is executed.

        Raises:
            ValueError: If it is not such a file, or damaged.
            FileNotFoundError: If there is no file.
        """
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            raise
        except Exception as error:  # torch.load fails in many ways on a damaged file
            reason = first_line(error)
            raise ValueError(f"result {path} cannot be read: {reason[:120]}") from error
        require_keys(content, ("result", "history", "scene"), f" of result {path}")
        result = cls.from_dict(content["result"], history=content["history"])
        result.scene = scene_from_dict(content["scene"])
        for implant, assembly in zip(result.implants, result.scene, strict=True):
            implant.cloud = assembly.implant
        return result

    def to_dict(self) -> dict[str, Any]:
        """Plain types and tensors, all that `from_dict` needs to warp any point as the result does.

        Raises:
            ValueError: If a parameter is not finite.
            NotImplementedError: If a deformation is of a model that cannot be written.
        """
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": "mm",
            "implants": [implant.to_dict() for implant in self.implants],
            "intensity": self.intensity,
            "blur_mm": self.blur_mm,
            "gc": self.gc.tolist(),
            "seed": self.seed,
            "status": self.status,
            "warnings": self.warnings,
            "diagnostics": self.diagnostics,
            "stages": self.stages,
            "view_motions": self.view_motions,
            "config": self.config.model_dump(mode="json"),
        }

    @classmethod
    def from_dict(cls, content: Any, *, history: list[dict[str, Any]] | None = None) -> RegistrationResult:
        """The result that `to_dict` wrote, in float64; it warps points to the same positions.

        Args:
            content: The dict; of format version 1 or 2.
            history: Records of the iterations, if available.

        Raises:
            ValueError: If a key is missing or malformed, or the format is a later one; the message names it.
        """
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            got = content.get("format") if isinstance(content, dict) else content
            raise ValueError(f"must be a {FORMAT!r}, got {got!r}")
        content = upgraded(content) if content.get("format_version") == 1 else content
        if content.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"format_version must be at most {FORMAT_VERSION}, got {content.get('format_version')!r}")
        require_keys(content, ("implants", "gc", "config"))
        if not isinstance(content["implants"], list) or not content["implants"]:
            raise ValueError("implants must be a list of one or more")
        return cls(
            implants=[RegisteredImplant.from_dict(implant) for implant in content["implants"]],
            gc=torch.tensor([float("nan") if x is None else float(x) for x in content["gc"]], device="cpu"),
            history=list(history or []),
            config=RegistrationConfig.model_validate(content["config"]),
            seed=int(content.get("seed", 0)),
            blur_mm=finite_number(content.get("blur_mm", 0.0), "blur_mm"),
            view_motions=_motions(content.get("view_motions")),
            status=content.get("status", "ok"),
            diagnostics=dict(content.get("diagnostics", {})),
            stages=list(content.get("stages", [])),
            warnings=[str(text) for text in content.get("warnings", [])],
            intensity={
                name: finite_number(value, f"intensity parameter {name}")
                for name, value in content.get("intensity", {}).items()
            },
        )

    def __repr__(self) -> str:
        gc = " ".join(f"{value:.3f}" for value in self.gc.tolist())
        names = ", ".join(implant.name for implant in self.implants)
        deviation = self.diagnostics.get("node_std_mm")
        expected = "" if deviation is None else f", expected error {deviation:.3f} mm"
        text = f"RegistrationResult({self.status}: {names}, gc {gc}{expected})"
        return "\n".join([text, *(f"  {warning}" for warning in self.warnings)])


def _motions(content: Any) -> Tensor | None:
    if content is None:
        return None
    number = len(content) if isinstance(content, (list, Tensor)) else 0
    return finite_array(content, (number, 4, 4), "view_motions")

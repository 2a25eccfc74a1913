"""A registration's result as plain data, and back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchkcreg.deformation import Deformation, FreeFormDeformation, RigidDeformation
from torchkcreg.implant import Screw
from torchkcreg.io.files import finite_array, finite_number, plain
from torchkcreg.registration import RegisteredImplant, RegistrationConfig, RegistrationResult
from torchkcreg.splines import ControlPointGrid

FORMAT = "torchkcreg deformation"
FORMAT_VERSION = 2


def result_to_dict(result: RegistrationResult) -> dict[str, Any]:
    """A result as plain data: all that `result_from_dict` needs to warp any point as the result does.

    Keys: `format`, `format_version`, `units`, `implants`, `intensity`, `gc` (one a view), `seed`, `status`, `warnings`,
    `diagnostics`, `stages`, `config`. Each implant has `name`, `material`, `implant_to_world` (4x4), `deformation`,
    `components` (name: 4x4 motion in the implant's frame), `screws` (`start`, `end`, `radius`, `material`, `name`) and
    `found` (names of the screws that were found). A deformation has `model` and what the model needs: "ffd" has `grid`
    (`shape`, `spacing_mm`, `grid_to_implant` 4x4), `control_points_mm` (nx, ny, nz, 3: displacements along the grid's
    axes) and `labels` (nx, ny, nz: group of each control point). The history is not in it.

    Raises:
        ValueError: a parameter is not finite.
        NotImplementedError: a deformation is of a model that cannot be written.
    """
    return plain(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": "mm",
            "implants": [_implant_to_dict(implant) for implant in result.implants],
            "intensity": result.intensity,
            "gc": result.gc,
            "seed": result.seed,
            "status": result.status,
            "warnings": result.warnings,
            "diagnostics": result.diagnostics,
            "stages": result.stages,
            "config": result.config.model_dump(mode="json"),
        }
    )


def _implant_to_dict(implant: RegisteredImplant) -> dict[str, Any]:
    _require_finite(implant.implant_to_world, "implant_to_world")
    for name, value in implant.deformation.named_parameters():
        _require_finite(value, name)
    for name, motion in implant.components.items():
        _require_finite(motion, f"motion of component {name}")
    return {
        "name": implant.name,
        "material": implant.material,
        "implant_to_world": implant.implant_to_world,
        "deformation": implant.deformation.to_dict(),
        "components": dict(implant.components),
        "screws": [screw.to_dict() for screw in implant.screws],
        "found": implant.found,
    }


def result_from_dict(content: Any, *, history: list[dict[str, Any]] | None = None) -> RegistrationResult:
    """The result described by `result_to_dict`, in float64; it warps points to the same positions.

    Args:
        content: the dict; of format version 1 or 2.
        history: records of the iterations, where they are at hand.

    Raises:
        ValueError: a key is missing or malformed, or the format is a later one; the message names it.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(
            f"must be a {FORMAT!r}, got {content.get('format') if isinstance(content, dict) else content!r}"
        )
    if content.get("format_version") == 1:
        content = _upgraded(content)
    if content.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"format_version must be at most {FORMAT_VERSION}, got {content.get('format_version')!r}")
    _require_keys(content, ("implants", "gc", "config"), "")
    if not isinstance(content["implants"], list) or not content["implants"]:
        raise ValueError("implants must be a list of one or more")
    return RegistrationResult(
        implants=[_implant(implant) for implant in content["implants"]],
        gc=torch.tensor([float("nan") if value is None else float(value) for value in content["gc"]]),
        history=list(history or []),
        config=RegistrationConfig.model_validate(content["config"]),
        seed=int(content.get("seed", 0)),
        status=content.get("status", "ok"),
        diagnostics=dict(content.get("diagnostics", {})),
        stages=list(content.get("stages", [])),
        warnings=[str(text) for text in content.get("warnings", [])],
        intensity={
            name: finite_number(value, f"intensity parameter {name}")
            for name, value in content.get("intensity", {}).items()
        },
    )


def _implant(content: Any) -> RegisteredImplant:
    _require_keys(content, ("implant_to_world", "deformation"), " of an implant")
    screws = content.get("screws", [])
    try:
        listed = [Screw(**screw) for screw in screws]
    except TypeError as error:
        raise ValueError(f"screws must have start, end, radius, material and name: {error}") from None
    return RegisteredImplant(
        name=str(content.get("name", "implant")),
        material=str(content.get("material", "implant")),
        implant_to_world=finite_array(content["implant_to_world"], (4, 4), "implant_to_world"),
        deformation=_deformation(content["deformation"]),
        components={
            name: finite_array(motion, (4, 4), f"motion of component {name}")
            for name, motion in content.get("components", {}).items()
        },
        screws=listed,
        found=[str(name) for name in content.get("found", [])],
    )


def _deformation(content: Any) -> Deformation:
    _require_keys(content, ("model",), " of a deformation")
    if content["model"] not in _READERS:
        raise ValueError(f"model must be one of {', '.join(_READERS)}, got {content['model']!r}")
    return _READERS[content["model"]](content)


def _free_form(content: dict[str, Any]) -> FreeFormDeformation:
    _require_keys(content, ("grid", "control_points_mm", "labels"), " of a deformation")
    grid = content["grid"]
    _require_keys(grid, ("shape", "spacing_mm", "grid_to_implant"), " of the grid")
    nx, ny, nz = (int(n) for n in finite_array(grid["shape"], (3,), "shape of the grid").tolist())
    sx, sy, sz = finite_array(grid["spacing_mm"], (3,), "spacing_mm of the grid").tolist()
    frame = finite_array(grid["grid_to_implant"], (4, 4), "grid_to_implant")
    points = finite_array(content["control_points_mm"], (nx, ny, nz, 3), "control_points_mm")
    labels = finite_array(content["labels"], (nx, ny, nz), "labels").long()
    return FreeFormDeformation(ControlPointGrid((nx, ny, nz), (sx, sy, sz), frame), points.double(), labels)


_READERS = {"ffd": _free_form, "rigid": lambda content: RigidDeformation()}


def _upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Plain data of format version 1, which knew one implant, as version 2."""
    of_implant = ("implant_to_world", "components", "grid", "control_points_mm", "labels", "screws_found")
    _require_keys(content, ("implant_to_world", "grid", "control_points_mm", "labels", "gc", "config"), "")
    found = [{**screw, "name": f"found{i}"} for i, screw in enumerate(content.get("screws_found", []))]
    implant = {
        "implant_to_world": content["implant_to_world"],
        "material": content["config"].get("material") or "implant",
        "deformation": {"model": "ffd", **{key: content[key] for key in ("grid", "control_points_mm", "labels")}},
        "components": content.get("components", {}),
        "screws": found,
        "found": [screw["name"] for screw in found],
    }
    options = {key: value for key, value in content["config"].items() if key != "stages"}
    rest = {key: value for key, value in content.items() if key not in of_implant}
    return {**rest, "format_version": 2, "implants": [implant], "config": options}


def _require_keys(content: Any, keys: tuple[str, ...], where: str) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"what should hold the {keys[0]!r}{where} must be an object, got {type(content).__name__}")
    for key in keys:
        if key not in content:
            raise ValueError(f"{key!r}{where} is missing")


def _require_finite(values: Tensor, name: str) -> None:
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} must be finite to be written: the registration diverged")

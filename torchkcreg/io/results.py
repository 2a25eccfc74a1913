"""A registration's result as plain data, and back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchkcreg.deformation import ControlPointGrid, FreeFormDeformation
from torchkcreg.io.files import finite_array, finite_number, plain
from torchkcreg.registration import RegistrationConfig, RegistrationResult

FORMAT = "torchkcreg deformation"
FORMAT_VERSION = 1


def result_to_dict(result: RegistrationResult) -> dict[str, Any]:
    """A result as plain data: all that `result_from_dict` needs to warp any point as the result does.

    Keys: `format`, `format_version`, `units`, `implant_to_world` (4x4), `grid` (`shape`, `spacing_mm`,
    `grid_to_implant` 4x4), `control_points_mm` (nx, ny, nz, 3: displacements along the grid's axes), `labels` (nx, ny,
    nz: group of each control point), `components` (name: 4x4 motion in the implant's frame), `intensity`, `gc` (one a
    view), `seed`, `status`, `warnings`, `diagnostics`, `config`. The history is not in it.

    Raises:
        ValueError: a parameter is not finite.
    """
    deformation = result.deformation
    _require_finite(result.implant_to_world, "implant_to_world")
    _require_finite(deformation.control_points, "control_points")
    for name, motion in result.components.items():
        _require_finite(motion, f"motion of component {name}")
    return plain(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": "mm",
            "implant_to_world": result.implant_to_world,
            "grid": {
                "shape": [int(n) for n in deformation.grid.shape],
                "spacing_mm": [float(s) for s in deformation.grid.spacing],
                "grid_to_implant": torch.as_tensor(deformation.grid.frame),
            },
            "control_points_mm": deformation.control_points,
            "labels": deformation.labels,
            "components": result.components,
            "screws_found": result.screws,
            "intensity": result.intensity,
            "gc": result.gc,
            "seed": result.seed,
            "status": result.status,
            "warnings": result.warnings,
            "diagnostics": result.diagnostics,
            "config": result.config.model_dump(mode="json"),
        }
    )


def result_from_dict(content: Any, *, history: list[dict[str, Any]] | None = None) -> RegistrationResult:
    """The result described by `result_to_dict`, in float64; it warps points to the same positions.

    Args:
        content: the dict.
        history: records of the iterations, where they are at hand.

    Raises:
        ValueError: a key is missing or malformed, or the format is a later one; the message names it.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(
            f"must be a {FORMAT!r}, got {content.get('format') if isinstance(content, dict) else content!r}"
        )
    if content.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"format_version must be {FORMAT_VERSION}, got {content.get('format_version')!r}")
    for key in ("implant_to_world", "grid", "control_points_mm", "labels", "gc", "config"):
        if key not in content:
            raise ValueError(f"{key!r} is missing")
    gc = torch.tensor([float("nan") if value is None else float(value) for value in content["gc"]])
    return RegistrationResult(
        implant_to_world=finite_array(content["implant_to_world"], (4, 4), "implant_to_world"),
        deformation=_deformation(content),
        gc=gc,
        history=list(history or []),
        config=RegistrationConfig.model_validate(content["config"]),
        seed=int(content.get("seed", 0)),
        status=content.get("status", "ok"),
        diagnostics=dict(content.get("diagnostics", {})),
        warnings=[str(text) for text in content.get("warnings", [])],
        components={
            name: finite_array(motion, (4, 4), f"motion of component {name}")
            for name, motion in content.get("components", {}).items()
        },
        screws=list(content.get("screws_found", [])),
        intensity={
            name: finite_number(value, f"intensity parameter {name}")
            for name, value in content.get("intensity", {}).items()
        },
    )


def _deformation(content: dict[str, Any]) -> FreeFormDeformation:
    grid = content["grid"]
    if not isinstance(grid, dict) or not {"shape", "spacing_mm", "grid_to_implant"} <= grid.keys():
        raise ValueError("grid must have shape, spacing_mm and grid_to_implant")
    nx, ny, nz = (int(n) for n in finite_array(grid["shape"], (3,), "shape of the grid").tolist())
    sx, sy, sz = finite_array(grid["spacing_mm"], (3,), "spacing_mm of the grid").tolist()
    frame = finite_array(grid["grid_to_implant"], (4, 4), "grid_to_implant")
    deformation = FreeFormDeformation(ControlPointGrid((nx, ny, nz), (sx, sy, sz), frame)).double()
    with torch.no_grad():
        deformation.control_points.copy_(
            finite_array(content["control_points_mm"], (nx, ny, nz, 3), "control_points_mm")
        )
        deformation.labels.copy_(finite_array(content["labels"], (nx, ny, nz), "labels").long())
    return deformation


def _require_finite(values: Tensor, name: str) -> None:
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} must be finite to be written: the registration diverged")

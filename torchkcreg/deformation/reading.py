"""Reads deformations from the plain types stored in files."""

from __future__ import annotations

from typing import Any

from torchkcreg.mechanics import Superelement
from torchkcreg.plain import finite_array, require_keys
from torchkcreg.splines import ControlPointGrid

from .deformation import Deformation
from .ffd import FreeFormDeformation
from .finite_elements import FiniteElementDeformation
from .linear import RigidDeformation


def deformation_from_dict(content: Any) -> Deformation:
    """Inverse of `Deformation.to_dict`, in float64. To add a model, add a line to the table `_READERS`.

    Raises:
        ValueError: If a key is missing or malformed; the message names it.
    """
    require_keys(content, ("model",), " of a deformation")
    if content["model"] not in _READERS:
        raise ValueError(f"model must be one of {', '.join(_READERS)}, got {content['model']!r}")
    return _READERS[content["model"]](content)


def _free_form(content: dict[str, Any]) -> FreeFormDeformation:
    require_keys(content, ("grid", "control_points_mm", "labels"), " of a deformation")
    grid = content["grid"]
    require_keys(grid, ("shape", "spacing_mm", "grid_to_implant"), " of the grid")
    nx, ny, nz = (int(n) for n in finite_array(grid["shape"], (3,), "shape of the grid").tolist())
    sx, sy, sz = finite_array(grid["spacing_mm"], (3,), "spacing_mm of the grid").tolist()
    frame = finite_array(grid["grid_to_implant"], (4, 4), "grid_to_implant")
    points = finite_array(content["control_points_mm"], (nx, ny, nz, 3), "control_points_mm")
    labels = finite_array(content["labels"], (nx, ny, nz), "labels").long()
    return FreeFormDeformation(ControlPointGrid((nx, ny, nz), (sx, sy, sz), frame), points.double(), labels)


def _finite_elements(content: dict[str, Any]) -> FiniteElementDeformation:
    require_keys(content, ("superelement", "amounts", "load_weight"), " of a deformation")
    superelement = Superelement.from_dict(content["superelement"])
    number, covariance, shares = superelement.num_amounts, content.get("covariance"), content.get("shares")
    sides = content.get("sides")
    return FiniteElementDeformation(
        superelement,
        finite_array(content["amounts"], (number,), "amounts"),
        load_weight=float(content["load_weight"]),
        unused=float(content.get("unused", 1.0)),
        shares=None if shares is None else finite_array(shares, (len(superelement.holds),), "shares"),
        sides=None if sides is None else finite_array(sides, (len(superelement.holds),), "sides"),
        covariance=None if covariance is None else finite_array(covariance, (number, number), "covariance"),
        rest=deformation_from_dict(content["rest"]) if content.get("rest") is not None else None,
    )


_READERS = {"fe": _finite_elements, "ffd": _free_form, "rigid": lambda content: RigidDeformation()}

"""Components that follow the implant (screws), as JSON: cylinders in the implant's frame."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from torchkcreg.implant import Screw
from torchkcreg.io.files import read_json, write_json
from torchkcreg.plain import finite_array, finite_number


def read_components(path: str | os.PathLike[str]) -> list[Screw]:
    """The cylinders of a JSON file `{"units": "mm", "screws": [{"from", "to", "radius", "material", "name"}, ...]}`.

    `from` is the head's end and `to` the tip, x, y, z in the implant's frame in mm; `material` may stand once for all
    beside `screws`; `name` defaults to screw0, screw1, ...; other keys are ignored.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: units other than mm, a missing key, an endless or thickless cylinder, two of one name; the message
            names the file, the screw and the key.
    """
    content = read_json(path, "components")
    try:
        if not isinstance(content, dict) or not isinstance(content.get("screws"), list):
            raise ValueError("must be a JSON object with a list 'screws'")
        if content.get("units", "mm") != "mm":
            raise ValueError(f"units must be mm, got {content['units']!r}")
        screws = [_screw(screw, i, content.get("material")) for i, screw in enumerate(content["screws"])]
        names = [screw.name for screw in screws]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"names must be unique, {twice[0]!r} is there {names.count(twice[0])} times")
    except ValueError as error:
        raise ValueError(f"components file {path}: {error}") from error
    return screws


def write_components(path: str | os.PathLike[str], screws: Sequence[Screw]) -> None:
    """Nothing; writes cylinders as `read_components` reads them."""
    listed = [
        {"name": s.name, "from": list(s.start), "to": list(s.end), "radius": s.radius, "material": s.material}
        for s in screws
    ]
    write_json(path, {"units": "mm", "frame": "the undeformed implant's", "screws": listed})


def _screw(screw: Any, i: int, material: Any) -> Screw:
    if not isinstance(screw, dict):
        raise ValueError(f"screw {i} must be an object with from, to, radius and material, got {screw!r}")
    for key in ("from", "to", "radius"):
        if key not in screw:
            raise ValueError(f"screw {i} has no {key!r}")
    start, end = (finite_array(screw[key], (3,), f"{key!r} of screw {i}") for key in ("from", "to"))
    if float((end - start).norm()) < 1e-6:
        raise ValueError(f"screw {i} has no length: 'from' and 'to' are both {start.tolist()}")
    material = screw.get("material", material)
    if not isinstance(material, str) or not material:
        raise ValueError(f"material of screw {i} must be a name, got {material!r}")
    name = screw.get("name", f"screw{i}")
    if not isinstance(name, str) or not name:
        raise ValueError(f"name of screw {i} must be a text, got {name!r}")
    radius = finite_number(screw["radius"], f"radius of screw {i}", positive=True)
    return Screw(_triple(start.tolist()), _triple(end.tolist()), radius, material, name)


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z

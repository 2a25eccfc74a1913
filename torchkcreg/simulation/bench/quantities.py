"""Quantities with units, as written in a recipe file: `188 mm`, `90 kV`, `[0, -300, 0] N`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

_UNITS = {
    "length": {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "µm": 1e-3},
    "angle": {"deg": 1.0, "°": 1.0, "rad": 180 / math.pi, "mrad": 0.18 / math.pi},
    "force": {"N": 1.0, "kN": 1000.0},
    "stiffness": {"N/mm": 1.0, "kN/mm": 1000.0, "N/m": 1e-3},
    "voltage": {"kV": 1.0, "kVp": 1.0, "V": 1e-3},
    "share": {"": 1.0, "%": 0.01},
}
_A = {kind: f"an {kind}" if kind == "angle" else f"a {kind}" for kind in _UNITS}
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s]*)\s*$")
_VECTOR = re.compile(r"^\s*\[(.*)\]\s*(\S*)\s*$", re.DOTALL)


def quantity(value: float | Sequence[float], unit: str) -> str:
    """A number, or three, with a unit, as recipes take them.

    >>> quantity(3.5, "mm"), quantity((0.0, 0.0, -600.0), "N")
    ('3.5 mm', '[0.0, 0.0, -600.0] N')
    """
    if isinstance(value, Sequence):
        return f"[{', '.join(repr(float(number)) for number in value)}] {unit}"
    return f"{float(value)!r} {unit}"


def _number(kind: str) -> Callable[[Any], float]:
    units = _UNITS[kind]

    def parsed(value: Any) -> float:
        if isinstance(value, str) and (match := _QUANTITY.match(value)):
            number, unit = float(match[1]), match[2]
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            number, unit = float(value), ""
        else:
            raise ValueError(f"must be {_A[kind]} such as {_example(kind)!r}, got {value!r}")
        if unit not in units and not (number == 0 and not unit):
            raise ValueError(f"must be {_A[kind]} in {', '.join(u for u in units if u) or 'no unit'}, got {value!r}")
        if not math.isfinite(number):
            raise ValueError(f"must be finite, got {value!r}")
        return number * units.get(unit, 1.0)

    return parsed


def _vector(kind: str) -> Callable[[Any], tuple[float, ...]]:
    number = _number(kind)

    def parsed(value: Any) -> tuple[float, ...]:
        unit = ""
        if isinstance(value, str) and (match := _VECTOR.match(value)):
            value, unit = match[1].split(","), match[2]
        if not isinstance(value, (list, tuple)) or len(value) != 3:
            raise ValueError(
                f"must be three of {_A[kind]} such as '[0, 0, 1] {_example(kind).split()[-1]}', got {value!r}"
            )
        return tuple(number(f"{element} {unit}" if unit else element) for element in value)

    return parsed


def _example(kind: str) -> str:
    return "10 %" if kind == "share" else f"10 {next(iter(_UNITS[kind]))}"


def _scalar_text(unit: str) -> PlainSerializer:
    return PlainSerializer(lambda value: f"{value:.12g} {unit}", return_type=str, when_used="json")


def _vector_text(unit: str) -> PlainSerializer:
    def written(value: Vector3) -> str:
        return f"[{', '.join(f'{x:.12g}' for x in value)}] {unit}"

    return PlainSerializer(written, return_type=str, when_used="json")


Vector3 = tuple[float, float, float]
Length = Annotated[float, BeforeValidator(_number("length")), _scalar_text("mm")]
"""A length, stored in mm; a unit is required."""
Angle = Annotated[float, BeforeValidator(_number("angle")), _scalar_text("deg")]
"""An angle, stored in degrees; a unit is required."""
Voltage = Annotated[float, BeforeValidator(_number("voltage")), _scalar_text("kV")]
"""A tube voltage, stored in kV; a unit is required."""
Stiffness = Annotated[float, BeforeValidator(_number("stiffness")), _scalar_text("N/mm")]
"""A stiffness, stored in N/mm; a unit is required."""
Share = Annotated[float, BeforeValidator(_number("share"))]
"""A fraction: a plain number or a percentage."""
Place = Annotated[Vector3, BeforeValidator(_vector("length")), _vector_text("mm")]
"""A point or a translation, stored in mm."""
Turn = Annotated[Vector3, BeforeValidator(_vector("angle")), _vector_text("deg")]
"""A rotation vector, stored in degrees."""
Push = Annotated[Vector3, BeforeValidator(_vector("force")), _vector_text("N")]
"""A force vector, stored in N."""

"""How stiff the alloys of implants are, and what they bear."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from torchkcreg.physics.materials import material, packaged_rows


@dataclass(frozen=True)
class ElasticConstants:
    """Of an isotropic elastic material.

    Attributes:
        youngs_modulus: N/mm^2.
        poisson: Poisson's ratio.
        yield_stress: Where it begins to stay bent, N/mm^2.
    """

    youngs_modulus: float
    poisson: float
    yield_stress: float

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's lambda and mu (the shear modulus), N/mm^2."""
        shear = self.youngs_modulus / (2 * (1 + self.poisson))
        return self.youngs_modulus * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson)), shear


def elastic_constants(name: str) -> ElasticConstants:
    """Of a packaged alloy, by the names that :func:`torchkcreg.physics.material` knows.

    Raises:
        ValueError: If there is no such material, or none that implants are made of.

    >>> elastic_constants("Ti-6Al-4V").youngs_modulus
    114000.0
    """
    key = material(name).name
    if key not in _table():
        raise ValueError(f"elastic constants are known of {', '.join(_table())}, not of {key}")
    return _table()[key]


def is_elastic(name: str) -> bool:
    """Whether the elastic constants of a packaged material are known.

    Raises:
        ValueError: If there is no such material.

    >>> is_elastic("steel"), is_elastic("water")
    (True, False)
    """
    return material(name).name in _table()


@cache
def _table() -> dict[str, ElasticConstants]:
    rows = packaged_rows("elastic.csv")
    return {row[0]: ElasticConstants(1000 * float(row[1]), float(row[2]), float(row[3])) for row in rows}

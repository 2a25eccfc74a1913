"""Attenuation (10 to 150 keV) and elastic constants of alloys, tissues and phantom materials, from packaged tables."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

_DISSOLVED = 200.0  # mg/mL of calcium; attenuation is linear in the concentration
_CALCIUM = re.compile(r"ca(\d+\.?\d*)")
ALIASES = {
    "316l": "steel",
    "stainless_steel": "steel",
    "ti6al4v": "titanium",
    "ti-6al-4v": "titanium",
    "cocrmo": "cocr",
    "aluminum": "aluminium",
    "bone": "cortical_bone",
    "trabecular_bone": "cancellous_bone",
    "fat": "adipose_tissue",
    "uhmwpe": "polyethylene",
}


@dataclass(frozen=True)
class Material:
    """A homogeneous material: density and a table of total mass attenuation.

    Attributes:
        name: Name for messages and labels.
        density_g_cm3: Density, g/cm^3.
        energies_kev: Rising energies, keV. An absorption edge is listed twice, with the values below and above it.
        mass_attenuation_cm2_g: Total mass attenuation coefficients at these energies, cm^2/g.

    Raises:
        ValueError: If the density is not positive or the table is not one of rising energies and positive values.

    >>> round(float(material("water").attenuation(60.0)), 5)
    0.02059
    """

    name: str
    density_g_cm3: float
    energies_kev: tuple[float, ...]
    mass_attenuation_cm2_g: tuple[float, ...]

    def __post_init__(self) -> None:
        energies, values = self.energies_kev, self.mass_attenuation_cm2_g
        if not self.density_g_cm3 > 0:
            raise ValueError(f"density of {self.name} must be positive, got {self.density_g_cm3}")
        if len(energies) != len(values) or len(energies) < 2:
            raise ValueError(f"table of {self.name} must pair 2 or more values, got {len(energies)} and {len(values)}")
        if min(values) <= 0 or any(b < a for a, b in pairwise(energies)):
            raise ValueError(f"table of {self.name} must have rising energies and positive values")

    def attenuation(self, energies_kev: Tensor | np.ndarray | Sequence[float] | float) -> Tensor:
        """Linear attenuation coefficients, 1/mm, float64, in the shape of the energies.

        Interpolated linearly in the logarithms of energy and attenuation, never across an absorption edge. At an edge
        the value above it is used.

        Args:
            energies_kev: Energies, keV, any shape, inside the table.

        Raises:
            ValueError: If an energy lies outside the table.
        """
        device = energies_kev.device if isinstance(energies_kev, Tensor) else "cpu"
        energies = torch.as_tensor(energies_kev, dtype=torch.float64, device=device)
        table = torch.tensor(self.energies_kev, dtype=torch.float64, device=energies.device)
        if energies.numel() and not bool(((energies >= table[0]) & (energies <= table[-1])).all()):
            low, high = float(energies.min()), float(energies.max())
            span = f"{table[0]:g} to {table[-1]:g} keV"
            raise ValueError(f"energies_kev must lie within {span} ({self.name}), got {low:g} to {high:g}")
        values = torch.tensor(self.mass_attenuation_cm2_g, dtype=torch.float64, device=energies.device).log()
        # right=True: no interval starts at the first of the two entries of an edge, so no width is zero
        lower = (torch.searchsorted(table, energies.contiguous(), right=True) - 1).clamp(0, len(table) - 2)
        table = table.log()
        fraction = (energies.log() - table[lower]) / (table[lower + 1] - table[lower])
        mass_attenuation = torch.lerp(values[lower], values[lower + 1], fraction).exp()
        return mass_attenuation * (self.density_g_cm3 / 10)

    def with_density(self, density_g_cm3: float) -> Material:
        """Same substance at another density, g/cm^3 (porous bone, a needle scintillator)."""
        return replace(self, density_g_cm3=float(density_g_cm3))


def material(name: str, *, density: float | None = None) -> Material:
    """Packaged material by its name (case does not matter), at its usual density or at `density` g/cm^3.

    Among others `steel` (316L, 7.95 g/cm^3), `titanium` (Ti-6Al-4V, 4.43), `cocr` (ASTM F75, 8.3), `aluminium`,
    `copper`, `water`, `soft_tissue`, `cortical_bone` (ICRU 44, 1.92), `cancellous_bone`, `pmma`, `csi`; the full list
    is `material_names()`. `ca50` is water with 50 mg/mL of calcium; other numbers work alike.

    Raises:
        ValueError: If there is no such material; the message lists the available ones.

    >>> material("steel").density_g_cm3, material("Ti-6Al-4V").name
    (7.95, 'titanium')
    """
    key = name.strip().lower().replace(" ", "_")
    key = ALIASES.get(key, key)
    if match := _CALCIUM.fullmatch(key):
        substance = calcium_in_water(float(match[1]))
    elif key in material_names():
        substance = _packaged_material(key)
    else:
        raise ValueError(f"material must be one of {', '.join(material_names())}, ca50 and so on, got {name!r}")
    return substance if density is None else substance.with_density(density)


def material_names() -> tuple[str, ...]:
    """Names of the packaged materials, without their aliases."""
    return tuple(_compositions())


def mixture(name: str, parts: Mapping[str, float], *, density: float) -> Material:
    """Mixture of packaged materials by mass.

    Args:
        name: Name of the mixture.
        parts: Mass of each packaged material, all in the same unit. They are normalised to fractions.
        density: Density of the mixture, g/cm^3.

    Raises:
        ValueError: If the masses are not all positive, or a material is unknown.

    >>> mixture("contrast", {"water": 0.98, "iodine": 0.02}, density=1.02).name
    'contrast'
    """
    if not parts or min(parts.values()) <= 0:
        raise ValueError(f"parts must be positive masses, got {dict(parts)}")
    substances = [material(part) for part in parts]
    masses = np.array(list(parts.values()), dtype=float)
    table = np.array([part.mass_attenuation_cm2_g for part in substances])
    return Material(name, float(density), substances[0].energies_kev, tuple((masses / masses.sum()) @ table))


def calcium_in_water(concentration_mg_ml: float) -> Material:
    """Calcium dissolved in water, as in calibration rods: the attenuations of water and calcium add up.

    The calcium adds mass but no volume: the density is 1 + concentration/1000 g/cm^3.

    Args:
        concentration_mg_ml: Calcium per volume, mg/mL; zero is water.

    Raises:
        ValueError: If the concentration is negative.

    >>> calcium_in_water(100).density_g_cm3
    1.1
    """
    if not concentration_mg_ml >= 0:
        raise ValueError(f"concentration_mg_ml must not be negative, got {concentration_mg_ml}")
    if concentration_mg_ml == 0:
        return material("water")
    calcium = concentration_mg_ml / 1000
    name = f"calcium_{concentration_mg_ml:g}_mg_ml"
    return mixture(name, {"water": 1.0, "calcium": calcium}, density=1.0 + calcium)


def calcium_attenuation(energies_kev: Sequence[float]) -> Tensor:
    """Increase of water's attenuation per mg/mL of dissolved calcium, 1/mm."""
    dissolved = calcium_in_water(_DISSOLVED).attenuation(energies_kev)
    return (dissolved - material("water").attenuation(energies_kev)) / _DISSOLVED


def calcium_of(attenuation: Tensor, reference_kev: float) -> Tensor:
    """Calcium concentration, mg/mL, from the attenuation (1/mm, at `reference_kev`) of a mixture of water and calcium.

    >>> round(float(calcium_of(calcium_in_water(150).attenuation((60.0,)), 60.0)))
    150
    """
    water = float(material("water").attenuation((reference_kev,))[0])
    return (attenuation - water) / float(calcium_attenuation((reference_kev,))[0])


def packaged_rows(file_name: str) -> Iterator[list[str]]:
    """Rows of a packaged table, without comment lines."""
    text = (resources.files("torchkcreg.physics") / "data" / file_name).read_text(encoding="utf-8")
    return csv.reader(line for line in text.splitlines() if not line.startswith("#"))


@cache
def _compositions() -> dict[str, tuple[float, dict[str, float]]]:
    """Density and mass fractions of the elements of each packaged material."""
    compositions = {}
    for name, density, fractions, _source in packaged_rows("materials.csv"):
        pairs = (pair.split(":") for pair in fractions.split())
        compositions[name] = (float(density), {symbol: float(fraction) for symbol, fraction in pairs})
    return compositions


@cache
def _element_table() -> tuple[tuple[float, ...], dict[str, np.ndarray]]:
    """Energies in keV and the mass attenuation of each element, cm^2/g."""
    header, *rows = packaged_rows("elements.csv")
    table = np.array(rows, dtype=float)
    return tuple(table[:, 0]), {symbol: table[:, column] for column, symbol in enumerate(header[1:], start=1)}


@cache
def _packaged_material(name: str) -> Material:
    """The packaged material of exactly this name."""
    density, fractions = _compositions()[name]
    energies, elements = _element_table()
    total = sum(fractions.values())
    values = sum(
        (fraction / total * elements[symbol] for symbol, fraction in fractions.items()), np.zeros(len(energies))
    )
    return Material(name, density, energies, tuple(values))


@dataclass(frozen=True)
class ElasticConstants:
    """Elastic constants of an isotropic material.

    Attributes:
        youngs_modulus: Young's modulus, N/mm^2.
        poisson: Poisson's ratio.
        yield_stress: Stress at which plastic deformation begins, N/mm^2.
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
    """Elastic constants of a packaged alloy, by its name as for `torchkcreg.physics.material`.

    Raises:
        ValueError: If there is no such material, or its elastic constants are not packaged.

    >>> elastic_constants("Ti-6Al-4V").youngs_modulus
    114000.0
    """
    key = material(name).name
    if key not in _table():
        raise ValueError(f"elastic constants are available for {', '.join(_table())}, not for {key}")
    return _table()[key]


def is_elastic(name: str) -> bool:
    """True if the elastic constants of a material are packaged.

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

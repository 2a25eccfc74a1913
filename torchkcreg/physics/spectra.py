"""X-ray spectra as the detector weighs them: tungsten tubes, filters, energy-integrating CsI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from torchkcreg.physics.materials import Material, material, packaged_rows
from torchkcreg.physics.reduction import effective_energies

DEFAULT_FILTRATION_MM = {"aluminium": 2.5, "copper": 0.2}
NEGLIGIBLE_WEIGHT = 1e-7
PACKAGED_ANODE_DEG = 12.0
_LOWEST_KVP, _HIGHEST_KVP, _LOWEST_KEV = 30.0, 150.0, 10.0


@dataclass(frozen=True)
class Spectrum:
    """What share of the detector's signal each energy makes, with nothing in the beam.

    Attributes:
        energies_kev: Rising energies, keV.
        weights: Detected energy at each of them; normalised to sum to one.

    Raises:
        ValueError: If the two do not pair, an energy does not rise, or a weight is negative.

    >>> Spectrum((40.0, 60.0), (1.0, 3.0)).mean_energy
    55.0
    """

    energies_kev: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        energies = tuple(float(energy) for energy in self.energies_kev)
        weights = np.asarray(self.weights, dtype=float)
        if len(energies) != len(weights) or not energies:
            raise ValueError(f"weights must pair with energies_kev, got {len(weights)} and {len(energies)}")
        if any(b <= a for a, b in pairwise(energies)):
            raise ValueError("energies_kev must rise")
        if not (np.isfinite(weights).all() and weights.min() >= 0 and weights.sum() > 0):
            raise ValueError("weights must be finite, not negative and not all zero")
        object.__setattr__(self, "energies_kev", energies)
        object.__setattr__(self, "weights", tuple(float(weight) for weight in weights / weights.sum()))

    @property
    def mean_energy(self) -> float:
        """Mean energy of the unattenuated signal, keV."""
        return float(np.dot(self.energies_kev, self.weights))

    def filtered(self, substance: Material, thickness_mm: float) -> Spectrum:
        """The spectrum behind a filter (a negative thickness takes one away), normalised again."""
        exponent = -substance.attenuation(self.energies_kev).numpy() * thickness_mm
        return Spectrum(self.energies_kev, tuple(np.array(self.weights) * np.exp(exponent - exponent.max())))

    def reduced(self, materials: Sequence[Material], num_bins: int = 20, *, tolerance: float = 2e-4) -> Spectrum:
        """The fewest effective energies that keep the transmission of these materials, six or so for a 90 kV beam.

        Aluminium is kept too, so that the result may be hardened or softened afterwards. The energies are real ones:
        other materials' attenuation at them makes sense, with a slightly larger error.

        Args:
            materials: What stands in the beam.
            num_bins: The most bins that may come back.
            tolerance: Largest relative error of the transmission, from 1 down to 1e-6, of each material and each two of
                them; the accuracy is what `num_bins` allows where it is not reached.

        Raises:
            ValueError: If `num_bins` is not positive.
        """
        if num_bins < 1:
            raise ValueError(f"num_bins must be positive, got {num_bins}")
        if len(self.energies_kev) <= 1:
            return self
        kept = {substance.name: substance for substance in (*materials, material("aluminium"))}
        energies, weights = np.array(self.energies_kev), np.array(self.weights)
        return Spectrum(*map(tuple, effective_energies(energies, weights, list(kept.values()), num_bins, tolerance)))


def tungsten_spectrum(
    kvp: float = 90,
    *,
    filtration_mm: Mapping[str, float] | None = None,
    csi_mm: float = 0.6,
    anode_deg: float = PACKAGED_ANODE_DEG,
) -> Spectrum:
    """Spectrum of a tungsten tube as a CsI detector absorbs it, weighted by energy.

    `w(E) = N(E) exp(-sum_f mu_f(E) t_f) (1 - exp(-mu_CsI(E) t)) E`, N from SpekPy 2 in bins of 1 keV: packaged for 70,
    80, 90, 100, 110 and 120 kV and an anode of 12 degrees, else computed where SpekPy is installed.

    Args:
        kvp: Tube voltage, kV.
        filtration_mm: Filters, material to mm; 2.5 mm of aluminium and 0.2 mm of copper where None.
        csi_mm: Thickness of the scintillator, mm of solid CsI.
        anode_deg: Angle of the anode.

    Raises:
        ValueError: If the voltage is not packaged and SpekPy is not installed, or a filter's material is unknown.

    >>> 50 < tungsten_spectrum(90).mean_energy < 60
    True
    """
    packaged = kvp in _anode_spectra() and anode_deg == PACKAGED_ANODE_DEG
    energies, photons = _anode_spectra()[int(kvp)] if packaged else _computed(kvp, anode_deg)
    exponent = np.zeros_like(energies)
    for name, thickness in (DEFAULT_FILTRATION_MM if filtration_mm is None else filtration_mm).items():
        exponent -= material(name).attenuation(energies).numpy() * thickness
    absorbed = -np.expm1(-material("csi").attenuation(energies).numpy() * csi_mm)
    weights = photons * np.exp(exponent) * absorbed * energies
    kept = weights > NEGLIGIBLE_WEIGHT * weights.sum()
    return Spectrum(tuple(energies[kept]), tuple(weights[kept]))


def _computed(kvp: float, anode_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies in keV and photons per keV before any filter, by SpekPy."""
    try:
        import spekpy
    except ImportError:
        voltages = ", ".join(map(str, _anode_spectra()))
        raise ValueError(
            f"kvp must be one of {voltages} and the anode's angle {PACKAGED_ANODE_DEG:g} degrees without SpekPy "
            f"(pip install 'torchkcreg[simulate]'), got {kvp:g} and {anode_deg:g}"
        ) from None
    if not (_LOWEST_KVP <= kvp <= _HIGHEST_KVP and 0 < anode_deg < 90):
        span = f"{_LOWEST_KVP:g} to {_HIGHEST_KVP:g}"
        raise ValueError(f"kvp must lie within {span} and the anode's angle within 0 to 90, got {kvp:g}, {anode_deg:g}")
    energies, photons = spekpy.Spek(kvp=float(kvp), th=float(anode_deg), dk=1).get_spectrum()
    kept = energies >= _LOWEST_KEV  # of the tables of attenuation
    return np.asarray(energies)[kept], np.asarray(photons)[kept]


@cache
def _anode_spectra() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Energies in keV and photons per keV before any filter, of each packaged tube voltage."""
    header, *rows = packaged_rows("tungsten_spectra.csv")
    table = np.array(rows, dtype=float)
    return {int(kvp): (table[:, 0], table[:, column]) for column, kvp in enumerate(header[1:], start=1)}

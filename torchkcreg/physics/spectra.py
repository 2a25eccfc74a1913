"""X-ray spectra weighted by the detector's response: tungsten tubes, filters, energy-integrating CsI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise

import numpy as np
from scipy.optimize import least_squares, nnls

from .materials import Material, material, packaged_rows

SMALLEST_TRANSMISSION = 1e-6
LENGTHS_PER_MATERIAL = 12
FIRST_NUM_BINS = 3
DEFAULT_FILTRATION_MM = {"aluminium": 2.5, "copper": 0.2}
NEGLIGIBLE_WEIGHT = 1e-7
PACKAGED_ANODE_DEG = 12.0
_LOWEST_KVP, _HIGHEST_KVP, _LOWEST_KEV = 30.0, 150.0, 10.0


def effective_energies(
    energies_kev: np.ndarray,
    weights: np.ndarray,
    materials: Sequence[Material],
    num_bins: int,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Energies and weights, at most `num_bins`, that reproduce `sum_k w_k exp(-sum_m mu_mk L_m)` within `tolerance`.

    Both are fitted to the transmission of each material and of each pair of materials, from 1 down to 1e-6, by least
    squares of the relative errors (variable projection): an inner non-negative least squares for the weights, an outer
    trust-region search for the energies. Grouping energies by attenuation alone would need several times as many bins.
    The number of bins grows from three until the largest relative error on the fitted lengths is below `tolerance`.

    Args:
        energies_kev: Rising energies, keV.
        weights: Their weights, summing to one.
        materials: Materials whose transmission is to be reproduced.
        num_bins: Largest number of energies.
        tolerance: Largest relative error of the transmission.
    """
    attenuations = np.stack([m.attenuation(energies_kev).numpy() for m in materials])
    lengths = _fitted_lengths(attenuations, weights)
    transmission = np.exp(-lengths @ attenuations) @ weights

    def responses(energies: np.ndarray) -> np.ndarray:
        table = np.stack([m.attenuation(energies).numpy() for m in materials])
        return np.exp(-lengths @ table) / transmission[:, None]

    def fitted_weights(energies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        columns = responses(energies)
        fitted, _ = nnls(columns, np.ones(len(columns)), maxiter=100 * len(energies))
        return fitted, columns @ fitted - 1

    best = (np.inf, energies_kev, weights)
    cumulative = np.cumsum(weights) - weights / 2
    low, high = np.interp([0.002, 0.998], cumulative, energies_kev)
    for number in range(min(FIRST_NUM_BINS, num_bins), num_bins + 1):
        start = np.linspace(low, high, number) if number > 1 else np.array([energies_kev @ weights])
        bounds = (energies_kev[0], energies_kev[-1])
        energies = least_squares(lambda e: fitted_weights(e)[1], start, bounds=bounds, max_nfev=30).x
        fitted, errors = fitted_weights(energies)
        if np.abs(errors).max() < best[0]:
            best = (np.abs(errors).max(), energies[fitted > 0], fitted[fitted > 0])
        if best[0] <= tolerance:
            break
    order = np.argsort(best[1])
    return best[1][order], best[2][order] / best[2].sum()


def _fitted_lengths(attenuations: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Path lengths (n, materials), mm, of each material and each pair, for transmissions from 1 to 1e-6."""
    num_materials = len(attenuations)
    ranges = []
    for attenuation in attenuations:
        longest = 0.1 / float(attenuation @ weights)
        while np.exp(-attenuation * 1.05 * longest) @ weights > SMALLEST_TRANSMISSION:
            longest *= 1.05
        ranges.append(longest * np.linspace(0.0, 1.0, LENGTHS_PER_MATERIAL) ** 2)
    rows = []
    for first, second in list(combinations(range(num_materials), 2)) or [(0, 0)]:
        for a in ranges[first]:
            for b in ranges[second] if second != first else [a]:
                row = np.zeros(num_materials)
                row[first], row[second] = a, b
                rows.append(row)
    lengths = np.unique(np.array(rows), axis=0)
    return lengths[np.exp(-lengths @ attenuations) @ weights > SMALLEST_TRANSMISSION]


@dataclass(frozen=True)
class Spectrum:
    """Share of each energy in the detected signal of the open beam.

    Attributes:
        energies_kev: Rising energies, keV.
        weights: Signal at each energy, normalised to sum to one.

    Raises:
        ValueError: If their numbers differ, energies do not rise, or a weight is negative.

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
        """Spectrum behind a filter, normalised again. A negative thickness removes filtration."""
        exponent = -substance.attenuation(self.energies_kev).numpy() * thickness_mm
        return Spectrum(self.energies_kev, tuple(np.array(self.weights) * np.exp(exponent - exponent.max())))

    def reduced(self, materials: Sequence[Material], num_bins: int = 20, *, tolerance: float = 2e-4) -> Spectrum:
        """Fewest effective energies that reproduce the transmission of these materials, about six for a 90 kV beam.

        Aluminium is always included, so that the result may be hardened or softened afterwards. The energies also serve
        for other materials, with a slightly larger error.

        Args:
            materials: Materials in the beam.
            num_bins: Largest number of energies.
            tolerance: Largest relative error of the transmission, from 1 down to 1e-6, of each material and each pair.
                It may be exceeded if `num_bins` is too small.

        Raises:
            ValueError: If `num_bins` is not positive.
        """
        if num_bins < 1:
            raise ValueError(f"num_bins must be positive, got {num_bins}")
        if len(self.energies_kev) <= 1:
            return self
        unique = {substance.name: substance for substance in (*materials, material("aluminium"))}
        energies, weights = np.array(self.energies_kev), np.array(self.weights)
        return Spectrum(*map(tuple, effective_energies(energies, weights, list(unique.values()), num_bins, tolerance)))


def tungsten_spectrum(
    kvp: float = 90,
    *,
    filtration_mm: Mapping[str, float] | None = None,
    csi_mm: float = 0.6,
    anode_deg: float = PACKAGED_ANODE_DEG,
) -> Spectrum:
    """Spectrum of a tungsten tube as absorbed by a CsI detector, weighted by energy.

    `w(E) = N(E) exp(-sum_f mu_f(E) t_f) (1 - exp(-mu_CsI(E) t)) E`, with N from SpekPy 2 in bins of 1 keV. Packaged for
    70, 80, 90, 100, 110 and 120 kV and an anode angle of 12 degrees; others are computed if SpekPy is installed.

    Args:
        kvp: Tube voltage, kV.
        filtration_mm: Thickness in mm of each filter material. None: 2.5 mm of aluminium and 0.2 mm of copper.
        csi_mm: Thickness of the scintillator, mm of solid CsI.
        anode_deg: Anode angle, degrees.

    Raises:
        ValueError: If voltage or angle are not packaged and SpekPy is not installed, or a filter's material is unknown.

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
    significant = weights > NEGLIGIBLE_WEIGHT * weights.sum()
    return Spectrum(tuple(energies[significant]), tuple(weights[significant]))


def _computed(kvp: float, anode_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies in keV and photons per keV before any filter, computed by SpekPy."""
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
    tabulated = energies >= _LOWEST_KEV  # where the attenuation tables begin
    return np.asarray(energies)[tabulated], np.asarray(photons)[tabulated]


@cache
def _anode_spectra() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Energies in keV and photons per keV before any filter, of each packaged tube voltage."""
    header, *rows = packaged_rows("tungsten_spectra.csv")
    table = np.array(rows, dtype=float)
    return {int(kvp): (table[:, 0], table[:, column]) for column, kvp in enumerate(header[1:], start=1)}

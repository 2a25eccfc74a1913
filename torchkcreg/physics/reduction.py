"""A spectrum's few effective energies: the smallest quadrature that transmits as the whole spectrum does."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares, nnls

from torchkcreg.physics.materials import Material

SMALLEST_TRANSMISSION = 1e-6
LENGTHS_PER_MATERIAL = 12
FIRST_NUM_BINS = 3


def effective_energies(
    energies_kev: np.ndarray,
    weights: np.ndarray,
    materials: Sequence[Material],
    num_bins: int,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Energies and weights, at most `num_bins`, that reproduce `sum_k w_k exp(-sum_m mu_mk L_m)` within `tolerance`.

    Both are fitted to the transmission of each material and of each pair of materials, from nothing down to a
    transmission of 1e-6, in the least squares of relative errors: the weights by non-negative least squares inside, the
    energies by a trust region outside (variable projection). Grouping by attenuation alone would need several times as
    many bins. The number grows from three until the largest relative error on the fitted lengths is below `tolerance`.

    Args:
        energies_kev: Rising energies, keV.
        weights: Their weights, summing to one.
        materials: Materials whose transmission is to be kept.
        num_bins: The most energies that may come back.
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
    """Path lengths (n, materials) in mm: each material alone and in pairs, transmission from 1 to 1e-6."""
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

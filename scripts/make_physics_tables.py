"""Write the tables in torchkcreg/physics/data: attenuation of the elements (xraydb) and tungsten spectra (SpekPy).

Needs xraydb and SpekPy (`pip install torchkcreg[simulate]`); the library itself needs neither. `materials.csv`, the
compositions, is written by hand and determines which elements are tabulated.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

DATA = Path(__file__).resolve().parent.parent / "torchkcreg" / "physics" / "data"
ENERGY_RANGE_KEV = (10.0, 150.0)
TUBE_VOLTAGES_KV = (70, 80, 90, 100, 110, 120)
ANODE_ANGLE_DEG = 12.0


def wanted_elements() -> list[str]:
    """Symbols of the elements used in `materials.csv`, sorted by atomic number."""
    import xraydb

    symbols = set()
    with open(DATA / "materials.csv") as file:
        for row in csv.reader(line for line in file if not line.startswith("#")):
            symbols.update(pair.split(":")[0] for pair in row[2].split())
    return sorted(symbols, key=xraydb.atomic_number)


def energy_grid(symbols: list[str]) -> np.ndarray:
    """Energies in keV. Each absorption edge of the elements is listed twice, for its two limits."""
    import xraydb

    low, high = ENERGY_RANGE_KEV
    smooth = np.concatenate([np.arange(low, 30.0, 0.5), np.arange(30.0, high + 0.5, 1.0)])
    edges = {e.energy / 1000 for s in symbols for e in xraydb.xray_edges(s).values()}
    edges = [e for e in edges if low < e < high]
    smooth = [e for e in smooth if e not in edges]
    return np.sort(np.concatenate([smooth, edges, edges]))


def mass_attenuation(symbol: str, energies: np.ndarray) -> np.ndarray:
    """Total mass attenuation of an element, cm^2/g; at an edge, the limits from below and from above.

    The edge energies and the jumps in xraydb's table differ by a few eV, so values at an edge are extrapolated from 10
    and 20 eV beside it.
    """
    import xraydb

    step = np.zeros_like(energies)
    first = np.flatnonzero(np.diff(energies) == 0)
    step[first], step[first + 1] = -0.01, 0.01
    near, far = (xraydb.mu_elam(symbol, 1000 * (energies + n * step)) for n in (1, 2))
    return near**2 / far


def write_elements() -> None:
    """Write total mass attenuation coefficients (cm^2/g) of the elements, one column each."""
    symbols = wanted_elements()
    energies = energy_grid(symbols)
    columns = [mass_attenuation(symbol, energies) for symbol in symbols]
    with open(DATA / "elements.csv", "w") as file:
        file.write(
            "# total mass attenuation, cm^2/g (Elam, Ravel & Sieber 2002, through xraydb); an edge stands twice\n"
        )
        file.write("energy_kev," + ",".join(symbols) + "\n")
        for energy, row in zip(energies, np.stack(columns, axis=1)):
            file.write(f"{energy:.7g}," + ",".join(f"{value:.5g}" for value in row) + "\n")


def write_spectra() -> None:
    """Write unfiltered tungsten spectra (photons per keV), one column per tube voltage."""
    import spekpy

    low, high = ENERGY_RANGE_KEV[0], max(TUBE_VOLTAGES_KV)
    centres = np.arange(low, high) + 0.5
    columns = []
    for kvp in TUBE_VOLTAGES_KV:
        energies, fluence = spekpy.Spek(kvp=kvp, th=ANODE_ANGLE_DEG, dk=1.0).get_spectrum()
        columns.append(np.interp(centres, energies, fluence, left=0.0, right=0.0))
    with open(DATA / "tungsten_spectra.csv", "w") as file:
        file.write(
            f"# photons/(keV cm^2 mAs) at 1 m, tungsten anode at {ANODE_ANGLE_DEG:g} degrees, no filter (SpekPy 2)\n"
        )
        file.write("energy_kev," + ",".join(str(kvp) for kvp in TUBE_VOLTAGES_KV) + "\n")
        for energy, row in zip(centres, np.stack(columns, axis=1)):
            file.write(f"{energy:g}," + ",".join(f"{value:.5g}" for value in row) + "\n")


if __name__ == "__main__":
    write_elements()
    write_spectra()

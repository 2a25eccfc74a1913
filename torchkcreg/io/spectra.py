"""X-ray spectra as text: two columns, photon energy in keV and detected weight."""

from __future__ import annotations

import os

from torchkcreg.io.files import write_text
from torchkcreg.io.tables import Column, read_table
from torchkcreg.physics import Spectrum

_LARGEST_KEV = 1000.0
_COLUMNS = [
    Column("energy", "keV", ("e", "energies", "photon energy")),
    Column("weight", "", ("weights", "detected weight", "detected energy weight", "counts", "fluence"), any_name=True),
]


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """The spectrum of a text table: energy in keV and the weight with which the detector counts it (any scale).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: energies are not positive, not rising, or too large for keV; a weight is negative, or all are 0.
    """
    table = read_table(path, "spectrum", _COLUMNS)
    energies, weights = table[:, 0], table[:, 1]
    if energies.min() <= 0 or energies.max() > _LARGEST_KEV:
        raise ValueError(
            f"spectrum file {path}: energies must be in keV, positive and at most {_LARGEST_KEV:g}, "
            f"got {energies.min():g} to {energies.max():g}"
        )
    try:
        return Spectrum(tuple(energies.tolist()), tuple(weights.tolist()))
    except ValueError as error:
        raise ValueError(f"spectrum file {path}: {error}") from error


def write_spectrum(path: str | os.PathLike[str], spectrum: Spectrum) -> None:
    """Nothing; writes a spectrum as `read_spectrum` reads it."""
    rows = [f"{float(e):.6g},{float(w):.9g}" for e, w in zip(spectrum.energies_kev, spectrum.weights)]
    write_text(path, "# energy_keV,detected_weight\n" + "\n".join(rows) + "\n")

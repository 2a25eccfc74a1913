"""Tube, detector and views of a simulated experiment, as a file says them."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from torchkcreg.config import Config
from torchkcreg.geometry import MultisourceScanner
from torchkcreg.physics.spectra import DEFAULT_FILTRATION_MM
from torchkcreg.simulation.bench.quantities import Angle, Length, Share, Voltage


class TubeRecipe(Config):
    """The beam: a tungsten tube behind its filters, as the scintillator absorbs it, or a table.

    Attributes:
        voltage: Without SpekPy one of 70, 80, ... 120 kV.
        anode: Its angle; other than 12 degrees with SpekPy alone.
        filtration: Materials and thicknesses.
        spectrum: Table of the detected spectrum in place of all of that, relative to the recipe's file.
        focal_spot: Its width, which blurs by the scanner's magnification.
    """

    voltage: Voltage = 90.0
    anode: Angle = 12.0
    filtration: dict[str, Length] = Field(default_factory=lambda: dict(DEFAULT_FILTRATION_MM))
    spectrum: Path | None = None
    focal_spot: Length = Field(0.3, ge=0)


class PanelRecipe(Config):
    """The detector, see `FlatPanel`; `gain_error`, `offset` and `dead_pixels` are what its correction has left."""

    scintillator: Length = Field(0.6, gt=0)
    half_contrast_lp_mm: float = Field(1.6, gt=0)
    glare: Share = Field(0.06, ge=0, lt=1)
    glare_reach: Length = Field(1.5, gt=0)
    photons: float = Field(2e4, gt=0)
    noise: bool = True
    electronic_noise: float = Field(2.0, ge=0)
    open_beam: float = Field(2800.0, gt=0)
    bits: int = Field(12, ge=1, le=16)
    gain_error: Share = Field(0.0, ge=0)
    offset: float = 0.0
    dead_pixels: Share = Field(0.0, ge=0, lt=1)
    supersample: int = Field(2, ge=1)


class ScannerRecipe(Config):
    """Where the views are taken from: the three-source extremity scanner, others built like it, or a geometry file.

    Attributes:
        geometry: File of projection matrices, relative to the recipe's, in place of the rest.
        sad, sdd: From the sources to the axis and to the detector.
        pixel: Its pitch.
        rows, cols: Pixels that are read, about the panel's middle.
        binning: Pixels along each side that are binned into one, after that.
        sources: Height of each focal spot, by name, as they fire in turn.
        firing_order: Their names.
        views: Numbers of the scan's views; all where None.
        num_views, step: Of a scan; `phase` is an angle at which the first source fires.
    """

    geometry: Path | None = None
    sad: Length = Field(404.0, gt=0)
    sdd: Length = Field(538.0, gt=0)
    pixel: Length = Field(0.388, gt=0)
    rows: int = Field(768, ge=1)
    cols: int = Field(320, ge=1)
    binning: int = Field(1, ge=1)
    sources: dict[str, Length] = Field(default_factory=lambda: dict(MultisourceScanner().source_z_mm))
    firing_order: tuple[str, ...] = ("T1", "T2", "T3", "T2")
    num_views: int = Field(200, ge=1)
    step: Angle = 1.0
    start: Angle = 0.0
    phase: Angle = 91.0
    views: tuple[int, ...] | None = None

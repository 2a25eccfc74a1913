"""The three-source extremity scanner: focal spots above each other that fire in turn while the gantry rotates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .circular import circular_geometry
from .cone_beam import ConeBeamGeometry


def _default_heights() -> dict[str, float]:
    return {"T1": 120.0, "T2": 0.0, "T3": -120.0}


@dataclass(frozen=True)
class MultisourceScanner:
    """The extremity CBCT scanner of Cao et al. 2020 (section 2.1), and others built like it.

    Attributes:
        sad: Distance from the sources to the axis of rotation, mm.
        sdd: Distance from the sources to the detector, mm.
        det_shape: Number of pixels (rows, cols).
        det_size_mm: Size (height, width) of the pixel array; 0.388 mm per pixel on the nominal 300 mm panel.
        source_z_mm: Height of each focal spot by name; T1 is superior.
        firing_order: Names of the sources in firing order, repeated over the scan.
        num_views: Number of views in a scan.
        step_deg: Gantry angle between views.
        start_deg: Gantry angle of the first view.
        phase_deg: A gantry angle at which the first source of the firing order fires. In the paper's three-view set T1
            fires at 91 degrees.

    >>> MultisourceScanner().geometry()
    ConeBeamGeometry(num_views=200, det_shape=(768, 768), pixel_spacing=(0.388, 0.388), sources=T1:50/T2:100/T3:50)
    """

    sad: float = 404.0
    sdd: float = 538.0
    det_shape: tuple[int, int] = (768, 768)
    det_size_mm: tuple[float, float] = (297.984, 297.984)
    source_z_mm: Mapping[str, float] = field(default_factory=_default_heights)
    firing_order: tuple[str, ...] = ("T1", "T2", "T3", "T2")
    num_views: int = 200
    step_deg: float = 1.0
    start_deg: float = 0.0
    phase_deg: float = 91.0

    def __post_init__(self) -> None:
        unknown = sorted(set(self.firing_order) - set(self.source_z_mm))
        if unknown or not self.firing_order:
            raise ValueError(f"firing_order must name sources of {sorted(self.source_z_mm)}, got {self.firing_order}")
        if self.num_views < 1 or self.step_deg <= 0:
            raise ValueError(
                f"num_views and step_deg must be positive, got num_views={self.num_views}, step_deg={self.step_deg}"
            )
        lag = (self.phase_deg - self.start_deg) / self.step_deg
        if abs(lag - round(lag)) > 1e-6:
            raise ValueError(f"phase_deg must be a whole number of steps from start_deg, got {lag} steps")

    @property
    def pixel_spacing(self) -> tuple[float, float]:
        """Pixel spacing (dv, du) in mm."""
        dv, du = (size / count for size, count in zip(self.det_size_mm, self.det_shape))
        return (round(dv, 12), round(du, 12))

    def view_sources(self) -> list[str]:
        """Name of the source of each view."""
        lag = round((self.phase_deg - self.start_deg) / self.step_deg)
        return [self.firing_order[(view - lag) % len(self.firing_order)] for view in range(self.num_views)]

    def geometry(self) -> ConeBeamGeometry:
        """Geometry of a whole scan with angles and source names."""
        sources = self.view_sources()
        return circular_geometry(
            [self.start_deg + view * self.step_deg for view in range(self.num_views)],
            sad=self.sad,
            sdd=self.sdd,
            det_shape=self.det_shape,
            pixel_spacing=self.pixel_spacing,
            source_z_mm=[self.source_z_mm[source] for source in sources],
            sources=sources,
        )

    def paper_views(self, name: str) -> list[int]:
        """Indices of the views used for registration in the paper (section 2.4).

        Args:
            name: `"12"`: 15, 30, ... 180 degrees with the sources in turn, four views per source (the nearest view of
                that source, at most 2 degrees off). `"3"`: adjacent views at 91 (T1), 92 (T2) and 93 degrees (T3).

        >>> MultisourceScanner().paper_views("3")
        [91, 92, 93]
        """
        if name == "12":
            angles, sources = [15.0 * step for step in range(1, 13)], ["T1", "T2", "T3"] * 4
        elif name == "3":
            angles, sources = [91.0, 92.0, 93.0], ["T1", "T2", "T3"]
        else:
            raise ValueError(f'name must be "12" or "3", got {name!r}')
        return self.geometry().nearest_views(angles, sources=sources)

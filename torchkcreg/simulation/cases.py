"""Weight-bearing cases with ground truth: recipes of the bench for a plated bone in front of the scanner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import ImplantPointCloud, Screw
from torchkcreg.mechanics import CarriedLoad
from torchkcreg.physics import Spectrum, line_integrals_from_intensity, tungsten_spectrum
from torchkcreg.scene import RegistrationData

from .bench.acquisition import Acquisition, acquisitions, panel_of, views_of
from .bench.loaded import ElasticConstruct, Loaded, loaded
from .bench.quantities import quantity
from .bench.recipe import LoadRecipe, PanelRecipe, Recipe
from .bench.specimen import Specimen, specimen
from .bench.standing import parts_in_beam
from .hardware import hole_positions, mapped
from .parts import Part

AXIAL_SCREW_HOLES = (0, 1, 3, 6, 8, 9)
S_BEND_SCREW_HOLES = (0, 1, 8, 9)
SMALLEST_TISSUE_RADIUS = 30.0  # smallest radius that contains plate and beads
_PANEL_SHAPE = (768, 768)
_LOADED = "loaded"


@dataclass(frozen=True, eq=False)
class SimulatedCase:
    """A simulated weight-bearing experiment with its ground truth. The implant's frame is the world's before the load.

    Attributes:
        geometry: The views.
        implant: Mesh of the undeformed plate.
        implant_material: Material of the plate.
        screws: Screws before the load.
        beads_before: Centres (B, 3) of the steel beads before the load, mm.
        beads_after: Centres (B, 3) of the beads under the load, mm; each moves with its bone fragment.
        deform: Maps points (..., 3) of the undeformed implant to their loaded positions.
        intensity: Counts (V, rows, cols), uint16.
        open_beam: Counts of the unattenuated beam, without scatter.
        saturation: The largest count.
        spectrum: The detected spectrum.
        load: Load on the plate.
        parts: Bodies in the beam.
        carried: Load carried by the plate; None unless a force bends it.
    """

    geometry: ConeBeamGeometry
    implant: trimesh.Trimesh
    implant_material: str
    screws: list[Screw]
    beads_before: Tensor
    beads_after: Tensor
    deform: Callable[[Tensor], Tensor]
    intensity: Tensor
    open_beam: float
    saturation: int
    spectrum: Spectrum
    load: LoadRecipe
    parts: list[Part]
    carried: CarriedLoad | None = None

    @classmethod
    def of(
        cls,
        phantom: Specimen,
        geometry: ConeBeamGeometry,
        spectrum: Spectrum,
        *,
        construct: ElasticConstruct | None = None,
        counts: Tensor | None = None,
    ) -> SimulatedCase:
        """The case of a specimen whose recipe has one configuration.

        Args:
            phantom: Specimen without load.
            geometry: The views.
            spectrum: Detected spectrum.
            construct: Elastic model of the specimen if it exists already.
            counts: Cached images: simulating them takes seconds.
        """
        recipe = phantom.recipe
        (name, load), *_ = recipe.configurations.items()
        if counts is None:
            taken = next(acquisitions(phantom, geometry, spectrum, progress=False, construct=construct))
        else:
            state: Loaded = loaded(phantom, load, construct)
            taken = Acquisition(name, state, parts_in_beam(phantom, state), counts, recipe.scatter_to_primary)
        return cls(
            geometry=geometry,
            implant=phantom.implant,
            implant_material=recipe.implant.material,
            screws=phantom.screws,
            beads_before=phantom.beads(),
            beads_after=phantom.beads_after(taken.loaded.fragments),
            deform=taken.loaded.implant,
            intensity=taken.counts,
            open_beam=recipe.panel.open_beam,
            saturation=panel_of(recipe).saturation,
            spectrum=spectrum,
            load=load,
            parts=taken.parts,
            carried=taken.loaded.carried,
        )

    def deformed_implant(self) -> trimesh.Trimesh:
        """Mesh of the plate under load."""
        return mapped(self.implant, self.deform)

    def data(self) -> RegistrationData:
        """The images as a registration reads them from files: line integrals; saturated pixels count."""
        lines, mask = line_integrals_from_intensity(self.intensity.float(), self.open_beam)
        return RegistrationData(self.geometry, lines, mask)

    def cloud(self, pitch: float = 0.25) -> ImplantPointCloud:
        """Nodes of the undeformed implant, `pitch` mm apart."""
        return ImplantPointCloud.from_mesh(self.implant, pitch)


def weight_bearing_case(
    load: float | LoadRecipe = 1.0,
    *,
    seed: int = 0,
    views: Sequence[int] = (47, 48, 49),
    det_shape: tuple[int, int] = (768, 320),
    binning: int = 1,
    mode: str = "axial",
    kvp: int = 90,
    tissue_radius_mm: float | None = None,
    panel: PanelRecipe | None = None,
    scatter_to_primary: float = 0.3,
) -> SimulatedCase:
    """A plated tibia under load: steel plate, screws, hollow bone with a gap, and beads, in three views.

    A ten-hole plate of 188 x 13.5 x 4.6 mm stands along z with the bone 17 mm behind it (negative y). Its screws, of
    2 mm radius, hold two rigid fragments. The plate is longer than the field of view of T1 and T3.

    Args:
        load: 0 (no load and no misalignment) to 1 (3 degrees of bending, 1 of torsion and a misalignment of about
            1.5 mm and 1 degree that depends on the seed) or more; or a `LoadRecipe`.
        seed: Seed of misalignment and noise.
        views: Views of `MultisourceScanner().geometry()`, whose index is their angle in degrees: (91, 92, 93) see the
            plate face on, (47, 48, 49) obliquely. Each of the two sets has a view of T1, T2 and T3.
        det_shape: Rows and columns of the part of the panel that is read, centred on the panel, before binning.
        binning: Pixels along each side that are binned into one.
        mode: `"axial"`: six screws, bending and torsion; `"s_bend"`: four outer screws, an S-bend and torsion.
        kvp: Tube voltage.
        tissue_radius_mm: Radius of soft tissue around the bone's axis, 30 or more; no tissue if None.
        panel: The detector; the default one if None.
        scatter_to_primary: Mean scatter over mean primary in the object's shadow.

    Raises:
        ValueError: If the mode is unknown, `det_shape` is larger than the panel, or the tissue is too thin for the
            plate.

    >>> case = weight_bearing_case(0.5, views=[47], binning=8)
    >>> case.intensity.shape, case.beads_after.shape
    (torch.Size([1, 96, 40]), torch.Size([8, 3]))
    """
    if mode not in ("axial", "s_bend"):
        raise ValueError(f"mode must be 'axial' or 's_bend', got {mode!r}")
    if tissue_radius_mm is not None and not tissue_radius_mm >= SMALLEST_TISSUE_RADIUS:
        raise ValueError(f"tissue_radius_mm must be {SMALLEST_TISSUE_RADIUS} or more, got {tissue_radius_mm}")
    if any(not 0 < asked <= there for asked, there in zip(det_shape, _PANEL_SHAPE, strict=True)):
        raise ValueError(f"det_shape must fit on the panel of {_PANEL_SHAPE} pixels, got {det_shape}")
    used = AXIAL_SCREW_HOLES if mode == "axial" else S_BEND_SCREW_HOLES
    if not isinstance(load, LoadRecipe):
        heights = hole_positions()
        load = _typical_load(float(load), mode, min(abs(heights[hole]) for hole in used), seed)
    recipe = Recipe.of(
        {
            "implant": {"plate": {}, "material": "steel"},
            "screws": {"holes": used},
            "limb": {
                "bone": {},
                "beads": [quantity(bead, "mm") for bead in _bead_positions().tolist()],
                "tissue": None if tissue_radius_mm is None else {"radius": quantity(tissue_radius_mm, "mm")},
            },
            "configurations": {_LOADED: load},
            "tube": {"voltage": quantity(kvp, "kV")},
            "panel": panel or PanelRecipe(),
            "scanner": {"rows": det_shape[0], "cols": det_shape[1], "binning": binning, "views": tuple(views)},
            "scatter_to_primary": scatter_to_primary,
            "seed": seed,
        }
    )
    return SimulatedCase.of(specimen(recipe), views_of(recipe.scanner), tungsten_spectrum(kvp))


def _typical_load(load: float, mode: str, zone_mm: float, seed: int) -> LoadRecipe:
    """Load of the given strength whose misalignment depends on the seed."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(2, 3))
    turn, shift = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    bending = {"bend": 3.0 * load, "lateral": 0.4 * load} if mode == "axial" else {"s_bend": 3.0 * load}
    return LoadRecipe.of(
        {
            **{name: quantity(angle, "deg") for name, angle in {**bending, "torsion": 1.0 * load}.items()},
            "zone": quantity(zone_mm, "mm"),
            "rotation": quantity((1.0 * load * turn).tolist(), "deg"),
            "translation": quantity((1.5 * load * shift).tolist(), "mm"),
        }
    )


def _bead_positions() -> Tensor:
    """Centres (8, 3) of two groups of beads beside the plate's ends, mm."""
    group = torch.tensor([[11.0, 3.0, 70.0], [-12.0, -2.0, 75.0], [10.0, -6.0, 82.0], [-10.0, 5.0, 88.0]]).double()
    return torch.cat([group * torch.tensor([1.0, 1.0, -1.0]), group * torch.tensor([-1.0, 1.0, 1.0])])

"""What a simulated experiment is made of, as a file says it: implant, screws, limb and loads, and the whole of it."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field, model_validator

from torchkcreg.geometry import MultisourceScanner
from torchkcreg.options import Config
from torchkcreg.physics.spectra import DEFAULT_FILTRATION_MM

from .quantities import Angle, Length, Place, Push, Share, Turn, Voltage


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


class PlateShape(Config):
    """A parametric plate along z, the bone on the side of negative y; see `locking_plate`.

    Attributes:
        bow, twist: Between the ends of the undeformed plate: it is contoured.
        flare: Width of the upper end over that of the shaft.
    """

    length: Length = 188.0
    width: Length = 13.5
    thickness: Length = 4.6
    holes: int = Field(10, ge=1)
    hole_radius: Length = 2.4
    hole_offset: Length = 0.0
    bow: Angle = 0.0
    twist: Angle = 0.0
    flare: float = Field(1.0, gt=0)


class ImplantRecipe(Config):
    """The undeformed implant: a parametric plate, or a closed mesh in mm whose frame is the world's.

    Attributes:
        mesh: File, relative to the recipe's.
        plate: In its place.
        material: Of it.
    """

    mesh: Path | None = None
    plate: PlateShape | None = None
    material: str = "steel"

    @model_validator(mode="after")
    def _one_shape(self) -> ImplantRecipe:
        if (self.mesh is None) == (self.plate is None):
            raise ValueError("an implant has either a mesh or a plate")
        return self


class HeadRecipe(Config):
    """A screw's head, that stands proud of the plate and of which `screws.json` does not know."""

    radius: Length = 3.4
    height: Length = 2.0


class ScrewsRecipe(Config):
    """Screws: those of a file, or one in each of the holes that are named.

    Attributes:
        file: As `--components` takes it, relative to the recipe's.
        holes: Of the implant, counted from 0 at its lower end.
        length, radius, material: Of each; as the implant's where no material is named.
        tilt: Largest angle against the hole's axis, drawn by the seed.
        heads: None stand proud unless described.
    """

    file: Path | None = None
    holes: tuple[int, ...] = ()
    length: Length = 36.0
    radius: Length = 2.0
    material: str | None = None
    tilt: Angle = 0.0
    heads: HeadRecipe | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ScrewsRecipe:
        if self.file is not None and self.holes:
            raise ValueError("screws come from a file or from holes, not from both")
        return self


class BoneRecipe(Config):
    """A hollow bone along z behind the implant, in two fragments, or as one where the gap is zero.

    Attributes:
        axis: A point on its axis.
        outer_radius, inner_radius: Of its wall.
        gap: Between the fragments, about `gap_at`.
        gap_at: Height of the fracture: screws below it hold the distal fragment.
        reach: How far each fragment goes from there.
        material, marrow: Of the wall, and of what fills it; nothing fills it unless named.
    """

    axis: Place = (0.0, -17.0, 0.0)
    outer_radius: Length = 13.0
    inner_radius: Length = 8.0
    gap: Length = 4.0
    gap_at: Length = 0.0
    reach: Length = 150.0
    material: str = "cortical_bone"
    marrow: str | None = None


class TissueRecipe(Config):
    """What is around the bone: a cylinder along z, or a closed mesh.

    Attributes:
        axis: A point on the cylinder's axis, mm; the bone's where None.
        half_length: Of it, about the axis' point.
        mesh: File, relative to the recipe's, in its place.
    """

    radius: Length | None = None
    axis: Place | None = None
    half_length: Length = 160.0
    mesh: Path | None = None
    material: str = "soft_tissue"

    @model_validator(mode="after")
    def _one_shape(self) -> TissueRecipe:
        if (self.mesh is None) == (self.radius is None):
            raise ValueError("tissue has either a radius or a mesh")
        return self


class InsertRecipe(Config):
    """A rod in the tissue, such as calcium inserts: `calcium` in mg/mL of water, or a material."""

    start: Place
    end: Place
    radius: Length
    calcium_mg_ml: float | None = Field(None, ge=0)
    material: str | None = None

    @model_validator(mode="after")
    def _one_material(self) -> InsertRecipe:
        if (self.calcium_mg_ml is None) == (self.material is None):
            raise ValueError("an insert has either calcium_mg_ml or a material")
        return self

    @property
    def substance(self) -> str:
        """Name of its material."""
        return self.material or f"ca{self.calcium_mg_ml:g}"


class LimbRecipe(Config):
    """What stands in the beam besides the implant and its screws.

    Attributes:
        mesh: Closed mesh of a bone that does not move, in place of `bone`; screws cut holes into it.
        beads: Centres of steel beads of 1 mm radius, each in the fragment at its height.
    """

    bone: BoneRecipe | None = None
    mesh: Path | None = None
    mesh_material: str = "cortical_bone"
    tissue: TissueRecipe | None = None
    inserts: tuple[InsertRecipe, ...] = ()
    beads: tuple[Place, ...] = ()
    bead_radius: Length = 1.0

    @property
    def axis(self) -> tuple[float, float, float]:
        """A point on the axis of cylindrical tissue, mm: its own, or the bone's."""
        own = None if self.tissue is None else self.tissue.axis
        return own or ((0.0, 0.0, 0.0) if self.bone is None else self.bone.axis)


class LoadRecipe(Config):
    """What happened to the implant in one configuration: forces, or angles that it was bent by; and where it stands.

    Attributes:
        force: On the proximal fragment along the world's axes; the distal one is held. The implant bends as its finite
            elements have it.
        at: Where that acts; where None, on the bone's axis at the fracture's height.
        bend, lateral, torsion, s_bend: Angles between the ends, in place of a force; see `Load`.
        zone: They lie within this of the middle.
        rotation, translation: Of the whole implant with its bone, about the origin.
    """

    force: Push = (0.0, 0.0, 0.0)
    at: Place | None = None
    bend: Angle = 0.0
    lateral: Angle = 0.0
    torsion: Angle = 0.0
    s_bend: Angle = 0.0
    zone: Length = 27.0
    rotation: Turn = (0.0, 0.0, 0.0)
    translation: Place = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _one_kind(self) -> LoadRecipe:
        if any(self.force) and self.bent:
            raise ValueError("a configuration has either a force or angles, not both")
        return self

    @property
    def bent(self) -> bool:
        """Angles are asked for."""
        return any((self.bend, self.lateral, self.torsion, self.s_bend))


class Recipe(Config):
    """A simulated experiment: one specimen, under one load or several, in one scanner.

    Attributes:
        scatter_to_primary: Mean scatter over mean primary in the object's shadow, over all views.
        configurations: Loads by the name that their images will have.
        seed: Of noise, tilts and the panel's faults.
    """

    implant: ImplantRecipe
    screws: ScrewsRecipe = ScrewsRecipe()
    limb: LimbRecipe = LimbRecipe()
    configurations: dict[str, LoadRecipe] = Field(default_factory=lambda: {"unloaded": LoadRecipe()})
    tube: TubeRecipe = TubeRecipe()
    panel: PanelRecipe = PanelRecipe()
    scanner: ScannerRecipe = ScannerRecipe()
    scatter_to_primary: Share = Field(0.3, ge=0)
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _named(self) -> Recipe:
        if not self.configurations:
            raise ValueError("there is no configuration")
        for name in self.configurations:
            if not re.fullmatch(r"[\w-]+", name):
                raise ValueError(f"a configuration's name is a file's: letters, digits, - and _, got {name!r}")
        return self

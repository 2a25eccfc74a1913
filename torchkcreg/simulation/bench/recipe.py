"""Recipe file of a simulated experiment: tube, detector, scanner, implant, screws, limb and loads."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field, model_validator

from torchkcreg.geometry import MultisourceScanner
from torchkcreg.options import Config
from torchkcreg.physics.spectra import DEFAULT_FILTRATION_MM

from .quantities import Angle, Length, Place, Push, Share, Stiffness, Turn, Voltage


class TubeRecipe(Config):
    """The X-ray tube: a tungsten anode with filters, or a table of the detected spectrum.

    The computed spectrum is weighted by the scintillator's absorption.

    Attributes:
        voltage: Tube voltage. Without SpekPy one of 70, 80, ... 120 kV.
        anode: Anode angle. Angles other than 12 degrees need SpekPy.
        filtration: Thickness of each filter, by material.
        spectrum: File of the detected spectrum, relative to the recipe's file. It replaces the settings above.
        focal_spot: Width of the focal spot; its blur depends on the magnification.
    """

    voltage: Voltage = 90.0
    anode: Angle = 12.0
    filtration: dict[str, Length] = Field(default_factory=lambda: dict(DEFAULT_FILTRATION_MM))
    spectrum: Path | None = None
    focal_spot: Length = Field(0.3, ge=0)


class PanelRecipe(Config):
    """The detector, see `FlatPanel`; `gain_error`, `offset` and `dead_pixels` are residuals after its correction."""

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
    """The views: the three-source extremity scanner, a scanner of the same design, or a geometry file.

    Attributes:
        geometry: File of projection matrices, relative to the recipe's file. It replaces all other settings.
        sad, sdd: Distance from the sources to the rotation axis and to the detector.
        pixel: Pixel pitch.
        rows, cols: Pixels that are read, centred on the panel.
        binning: Pixels along each side that are binned into one, after the cropping.
        sources: Height of each focal spot, by name.
        firing_order: Names of the focal spots in the order in which they fire.
        num_views: Number of views of the whole scan.
        step: Gantry angle between successive views.
        start: Gantry angle of the first view.
        phase: A gantry angle at which the first source of `firing_order` fires.
        views: Numbers of the scan's views that are simulated; all where None.
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
    """A parametric plate along z, with the bone at negative y; see `locking_plate`.

    Attributes:
        bow, twist: Contouring of the undeformed plate: bending and torsion angle between its ends.
        flare: Width of the upper end divided by the width of the shaft.
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
        mesh: File of the mesh, relative to the recipe's file.
        plate: Parametric plate, instead of a mesh.
        material: Name of the implant's material.
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
    """A screw's head above the plate. It is in the images but not in `screws.json`."""

    radius: Length = 3.4
    height: Length = 2.0


class ScrewsRecipe(Config):
    """Screws, from a file or one in each of the given holes.

    Attributes:
        file: File of screws as for `--components`, relative to the recipe's file.
        holes: Holes of the implant that have a screw, counted from 0 at its lower end.
        length, radius: Size of every screw.
        material: Material of every screw; the implant's if None.
        tilt: Largest angle between a screw and its hole's axis. The angles are random.
        heads: Heads above the plate; none if None.
        loose: Numbers of screws, counted from 0, that no longer hold in the bone: they move with the implant.
    """

    file: Path | None = None
    holes: tuple[int, ...] = ()
    length: Length = 36.0
    radius: Length = 2.0
    material: str | None = None
    tilt: Angle = 0.0
    heads: HeadRecipe | None = None
    loose: tuple[int, ...] = ()

    @model_validator(mode="after")
    def _one_source(self) -> ScrewsRecipe:
        if self.file is not None and self.holes:
            raise ValueError("screws come from a file or from holes, not from both")
        return self


class BoneRecipe(Config):
    """A hollow bone along z behind the implant, in two fragments that touch if the gap is zero.

    Attributes:
        axis: A point on the bone's axis.
        outer_radius, inner_radius: Radii of the cortex.
        gap: Distance between the fragments, centred on `gap_at`.
        gap_at: Height of the fracture. Screws below it hold the distal fragment.
        callus: Axial stiffness of elastic tissue that fills the gap, as wide as the cortex; it shares a force.
        reach: Distance from the fracture to the far end of each fragment.
        material: Material of the cortex.
        marrow: Material that fills the bone; empty if None.
    """

    axis: Place = (0.0, -17.0, 0.0)
    outer_radius: Length = 13.0
    inner_radius: Length = 8.0
    gap: Length = 4.0
    gap_at: Length = 0.0
    callus: Stiffness = Field(0.0, ge=0)
    reach: Length = 150.0
    material: str = "cortical_bone"
    marrow: str | None = None


class TissueRecipe(Config):
    """Soft tissue or water around the bone: a cylinder along z, or a closed mesh.

    Attributes:
        radius: Radius of the cylinder.
        axis: A point on the cylinder's axis, mm; the bone's where None.
        half_length: Half the cylinder's length, measured from the point `axis`.
        mesh: File of a mesh instead of the cylinder, relative to the recipe's file.
        material: Name of the material.
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
    """A rod in the tissue: a calcium insert (`calcium_mg_ml`, mg per mL of water), or a rod of another material."""

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
        """Name of the rod's material."""
        return self.material or f"ca{self.calcium_mg_ml:g}"


class LimbRecipe(Config):
    """Bone, tissue, inserts and beads around the implant.

    Attributes:
        bone: Parametric bone of two fragments.
        mesh: File of the closed mesh of a bone that does not move. Screws cut holes into it.
        mesh_material: Material of that bone.
        tissue: Tissue around everything.
        inserts: Rods in the tissue.
        beads: Centres of steel beads, each attached to the fragment at its height.
        bead_radius: Radius of the beads.
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
        """A point on the axis of the tissue cylinder, mm; on the bone's axis if the tissue has none."""
        tissue_axis = None if self.tissue is None else self.tissue.axis
        return tissue_axis or ((0.0, 0.0, 0.0) if self.bone is None else self.bone.axis)


class LoadRecipe(Config):
    """Load of one configuration: a force or bending angles, and a rigid misalignment.

    Attributes:
        force: Force on the proximal fragment along the world's axes, with the distal fragment held. The bending is
            computed by finite elements.
        at: Point where the force acts; if None, on the bone's axis at the height of the fracture.
        bend, lateral, torsion, s_bend: Angles between the implant's ends, instead of a force; see `Load`.
        zone: The implant is bent within this distance of `center`.
        center: Height of the middle of the bent stretch.
        rotation, translation: Rigid motion of the implant with its bone, about the origin.
    """

    force: Push = (0.0, 0.0, 0.0)
    at: Place | None = None
    bend: Angle = 0.0
    lateral: Angle = 0.0
    torsion: Angle = 0.0
    s_bend: Angle = 0.0
    zone: Length = 27.0
    center: Length = 0.0
    rotation: Turn = (0.0, 0.0, 0.0)
    translation: Place = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _one_kind(self) -> LoadRecipe:
        if any(self.force) and self.bent:
            raise ValueError("a configuration has either a force or angles, not both")
        return self

    @property
    def bent(self) -> bool:
        """True if a bending angle is given."""
        return any((self.bend, self.lateral, self.torsion, self.s_bend))


class Recipe(Config):
    """A simulated experiment: one specimen, under one load or several, in one scanner.

    Attributes:
        scatter_to_primary: Mean scatter over mean primary in the object's shadow, over all views.
        configurations: Loads by configuration name, which is also the name of the images' file.
        seed: Seed of the noise, the screws' tilts and the panel's faults.
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

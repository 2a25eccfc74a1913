"""Weight-bearing cases with ground truth: a plated bone under load in the multisource scanner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner, fit_rigid
from torchkcreg.implant import Screw
from torchkcreg.mechanics import CarriedLoad
from torchkcreg.physics import Spectrum, tungsten_spectrum

from .hardware import hole_positions, locking_plate, locking_screws, mapped
from .loads import Load
from .parts import Part
from .scanner import DetectorModel, simulate_projections
from .solids import Cylinder, Sphere, Tube

AXIAL_SCREW_HOLES = (0, 1, 3, 6, 8, 9)
S_BEND_SCREW_HOLES = (0, 1, 8, 9)
BEAD_RADIUS = 1.0
BONE_OFFSET_Y = -17.0
GAP = 4.0
FRAGMENTS = ("distal", "proximal")
SMALLEST_TISSUE_RADIUS = 30.0  # smallest cylinder that contains plate and beads


@dataclass(frozen=True, eq=False)
class SimulatedCase:
    """A simulated weight-bearing experiment. Before the load the implant's frame is the world's.

    Attributes:
        geometry: The views.
        implant: Mesh of the undeformed plate.
        implant_material: Material of the plate.
        screws: Screws of the undeformed plate.
        beads_before: Centres (8, 3) of the steel beads without load, mm.
        beads_after: True centres (8, 3) of the beads under load, mm.
        deform: Maps points (..., 3) of the undeformed frame, nodes or beads, to their loaded positions.
        intensity: Counts (V, rows, cols), uint16.
        open_beam: Counts of the unattenuated beam, without scatter.
        saturation: The largest count.
        spectrum: The detected spectrum.
        load: The load on the plate.
        parts: Bodies in the beam.
        carried: Load carried by the plate; None if it is not known.
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
    load: Load
    parts: list[Part]
    carried: CarriedLoad | None = None

    def deformed_implant(self) -> trimesh.Trimesh:
        """True mesh of the plate under load."""
        return mapped(self.implant, self.deform)


def weight_bearing_case(
    load: float | Load = 1.0,
    *,
    seed: int = 0,
    views: Sequence[int] = (47, 48, 49),
    det_shape: tuple[int, int] = (768, 320),
    binning: int = 1,
    mode: str = "axial",
    kvp: int = 90,
    tissue_radius_mm: float | None = None,
    detector: DetectorModel | None = None,
) -> SimulatedCase:
    """A plated tibia under load: steel plate, screws, hollow bone with a gap, beads, three views.

    A ten-hole plate of 188 x 13.5 x 4.6 mm lies along z, with the bone 17 mm behind it (negative y). Its screws, of
    2 mm radius, hold the two fragments, which follow them rigidly. The plate is longer than the field of view of T1
    and T3.

    Args:
        load: Strength from 0 (no load and no misalignment) to 1 (3 degrees of bending, 1 of torsion and a
            misalignment of about 1.5 mm and 1 degree that depends on the seed) or more; or a `Load`.
        seed: Seed of misalignment and noise.
        views: Views of `MultisourceScanner().geometry()`, whose index is their angle in degrees: (91, 92, 93) see the
            plate face on, (47, 48, 49) obliquely; each three have T1, T2, T3.
        det_shape: Rows and columns of the central part of the panel that is read, before binning.
        binning: Pixels along each side that are binned into one.
        mode: `"axial"`: six screws, bending and torsion; `"s_bend"`: four outer screws, an S-bend and torsion.
        kvp: Tube voltage.
        tissue_radius_mm: Radius of the soft tissue around the bone's axis, 30 or more; no tissue by default.
        detector: Detector model; the default one if None.

    Raises:
        ValueError: If the mode is unknown, the panel smaller than `det_shape`, or the tissue too thin for the plate.

    >>> case = weight_bearing_case(0.5, views=[47], binning=8)
    >>> case.intensity.shape, case.beads_after.shape
    (torch.Size([1, 96, 40]), torch.Size([8, 3]))
    """
    if mode not in ("axial", "s_bend"):
        raise ValueError(f"mode must be 'axial' or 's_bend', got {mode!r}")
    if tissue_radius_mm is not None and not tissue_radius_mm >= SMALLEST_TISSUE_RADIUS:
        raise ValueError(f"tissue_radius_mm must be {SMALLEST_TISSUE_RADIUS} or more, got {tissue_radius_mm}")
    holes = hole_positions()
    used = [holes[hole] for hole in (AXIAL_SCREW_HOLES if mode == "axial" else S_BEND_SCREW_HOLES)]
    if not isinstance(load, Load):
        load = _typical_load(float(load), mode, min(abs(z) for z in used), seed)
    detector = detector or DetectorModel()
    deform = load.motion()
    plate, screws, beads = locking_plate(), locking_screws(used), _bead_positions()
    parts = _parts_in_beam(plate, screws, beads, deform, tissue_radius_mm)
    geometry = _cropped(det_shape, binning).select(list(views))
    spectrum = tungsten_spectrum(kvp)
    return SimulatedCase(
        geometry=geometry,
        implant=plate,
        implant_material="steel",
        screws=screws,
        beads_before=beads,
        beads_after=deform(beads),
        deform=deform,
        intensity=simulate_projections(geometry, parts, spectrum, detector=detector, seed=seed),
        open_beam=detector.open_beam,
        saturation=detector.saturation,
        spectrum=spectrum,
        load=load,
        parts=parts,
    )


def _typical_load(load: float, mode: str, zone_mm: float, seed: int) -> Load:
    """Load of the given strength, with a misalignment that depends on the seed."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(2, 3))
    turn, shift = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    bending = {"bend_deg": 3.0 * load, "lateral_deg": 0.4 * load} if mode == "axial" else {"s_bend_deg": 3.0 * load}
    return Load(
        **bending,
        torsion_deg=1.0 * load,
        zone_mm=zone_mm,
        rotation_deg=tuple((1.0 * load * turn).tolist()),
        translation_mm=tuple((1.5 * load * shift).tolist()),
    )


def _bead_positions() -> Tensor:
    """Centres (8, 3) of two groups of beads near the plate's ends, mm."""
    group = torch.tensor([[11.0, 3.0, 70.0], [-12.0, -2.0, 75.0], [10.0, -6.0, 82.0], [-10.0, 5.0, 88.0]]).double()
    return torch.cat([group * torch.tensor([1.0, 1.0, -1.0]), group * torch.tensor([-1.0, 1.0, 1.0])])


def _parts_in_beam(
    plate: trimesh.Trimesh,
    screws: list[Screw],
    beads: Tensor,
    deform: Callable[[Tensor], Tensor],
    tissue_radius_mm: float | None,
) -> list[Part]:
    """The loaded plate, its screws, the bone's fragments, beads and soft tissue."""
    tissue = None if tissue_radius_mm is None else "tissue"
    parts = [Part("plate", mapped(plate, deform), "steel", inside=tissue)]
    for number, screw in enumerate(screws):
        head, tip = deform(torch.tensor([screw.start, screw.end], dtype=torch.float64))
        cylinder = Cylinder(head, tip, screw.radius)
        parts.append(Part(f"screw{number}", cylinder, screw.material, (fragment_at(screw.start[2]),), tissue))
    for fragment, side in zip(FRAGMENTS, (-1.0, 1.0)):
        held = [[screw.start, screw.end] for screw in screws if fragment_at(screw.start[2]) == fragment]
        points = torch.tensor(held, dtype=torch.float64).reshape(-1, 3)
        near, far = _bone_axis(side * GAP / 2, side * 150.0)
        bone = Tube(near, far, outer_radius=13.0, inner_radius=8.0).moved(fit_rigid(points, deform(points)))
        parts.append(Part(fragment, bone, "cortical_bone", inside=tissue))
    for number, center in enumerate(deform(beads)):
        parts.append(Part(f"bead{number}", Sphere(center, BEAD_RADIUS), "steel", inside=tissue))
    if tissue_radius_mm is not None:
        near, far = _bone_axis(-160.0, 160.0)
        parts.append(Part("tissue", Cylinder(near, far, tissue_radius_mm), "soft_tissue"))
    return parts


def fragment_at(height: float) -> str:
    """Name of the bone fragment at a height z in mm: distal below the gap, proximal above."""
    return FRAGMENTS[0] if height < 0 else FRAGMENTS[1]


def _bone_axis(*heights: float) -> Tensor:
    """Points (n, 3) on the bone's axis at heights z in mm."""
    return torch.tensor([[0.0, BONE_OFFSET_Y, z] for z in heights], dtype=torch.float64)


def _cropped(det_shape: tuple[int, int], binning: int) -> ConeBeamGeometry:
    """Geometry of the whole scan, with the panel cropped about its centre and binned."""
    scanner = MultisourceScanner()
    if not all(0 < size <= whole for size, whole in zip(det_shape, scanner.det_shape)):
        raise ValueError(f"det_shape must fit into the panel's {scanner.det_shape}, got {tuple(det_shape)}")
    first = [(whole - size) // 2 for size, whole in zip(det_shape, scanner.det_shape)]
    rows, cols = (slice(start, start + size) for start, size in zip(first, det_shape))
    geometry = scanner.geometry().crop(rows, cols)
    return geometry if binning == 1 else geometry.bin(binning)

"""Random weight-bearing cases: clinically varied plates, screws, limbs, spectra, scanners and loads, as recipes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner
from torchkcreg.implant import Screw
from torchkcreg.mechanics import von_mises
from torchkcreg.physics import tungsten_spectrum

from .bench.loaded import ElasticConstruct
from .bench.quantities import quantity
from .bench.recipe import LoadRecipe, PanelRecipe, Recipe
from .bench.specimen import Specimen, parametric_plate, specimen
from .cases import SimulatedCase
from .hardware import hole_positions
from .loads import RodMotion

_KILOVOLTS = (70, 80, 90, 100, 110, 120)
_GAP_MM = 4.0
_TO_BONE_MM = 1.5  # distance between plate and bone
_STRESSED = (0.2, 0.8)  # range of an elastic plate's highest stress, as a share of the yield stress
_HIGHEST = 0.98  # quantile taken as the highest stress
ViewSet = Literal["neighbours", "around", "both", "spread", "many"]


@dataclass(frozen=True)
class Draw:
    """Parameters drawn for a case; lengths in mm, angles in degrees.

    Attributes:
        seed: Seed of the draw.
        material, screw_material: Materials of plate and screws.
        num_holes, pitch, width, thickness: Size of the plate; `pitch` is the distance between holes.
        hole_offset: 0 for round holes, else half the distance between the two circles of a combination hole.
        flare: Width of the plate's upper end divided by the width of its shaft.
        bow_deg, twist_deg: Contouring of the undeformed plate: bending and torsion angle between its ends.
        holes_used: Indices of the holes with screws.
        loose: Index, within `holes_used`, of a screw that is loose in its bone; None if all hold.
        tilt_deg: Largest angle between a screw and its hole's axis.
        heads: True if the screws have heads above the plate, which are imaged but not in the list of screws.
        bend_deg, s_bend_deg, torsion_deg, lateral_deg: Load: angles between the innermost screws that hold.
        turn_deg, shift: Misalignment of the whole plate: rotation and translation vector.
        scanner: "extremity" or "c-arm".
        azimuth_deg: Gantry angle of the first of three neighbouring views; the plate is seen face on at 90.
        kvp: Tube voltage.
        water_radius: Radius of the water cylinder (the limb) around the bone's axis; 0: a bare bone.
        bone_radius, cortex: Outer radius and wall thickness of the hollow bone.
        marrow: True if cancellous bone fills the hollow bone.
        focal_spot: Width of the focal spot, mm.
        panel: The detector.
        scatter_to_primary: Mean scatter over mean primary in the object's shadow.
    """

    seed: int
    material: str
    screw_material: str
    num_holes: int
    pitch: float
    width: float
    thickness: float
    hole_offset: float
    flare: float
    bow_deg: float
    twist_deg: float
    holes_used: tuple[int, ...]
    loose: int | None
    tilt_deg: float
    heads: bool
    bend_deg: float
    s_bend_deg: float
    torsion_deg: float
    lateral_deg: float
    turn_deg: tuple[float, float, float]
    shift: tuple[float, float, float]
    scanner: Literal["extremity", "c-arm"]
    azimuth_deg: float
    kvp: int
    water_radius: float
    bone_radius: float
    cortex: float
    marrow: bool
    focal_spot: float
    panel: PanelRecipe
    scatter_to_primary: float

    @property
    def length(self) -> float:
        """Length of the plate, mm."""
        return self.num_holes * self.pitch + 8.0

    @property
    def bone_y(self) -> float:
        """Position y of the bone's axis behind the plate, mm."""
        return -(self.thickness / 2 + _TO_BONE_MM + self.bone_radius)

    @property
    def hole_heights(self) -> list[float]:
        """Heights of the holes on the straight plate, mm."""
        return hole_positions(length=self.length, num_holes=self.num_holes)


def draw_case(seed: int) -> Draw:
    """Draw the parameters of a case. All choices are independent, in realistic ranges of plates, limbs and scanners.

    >>> draw_case(3) == draw_case(3), draw_case(3) == draw_case(4)
    (True, False)
    """
    rng = np.random.default_rng([seed, 20])
    num_holes = int(rng.integers(6, 11))
    lower = num_holes // 2  # the gap lies between two holes
    inner = 1 if rng.random() < 0.5 else 0
    sides = []
    for holes in (range(lower - 1 - inner, -1, -1), range(lower + inner, num_holes)):
        count = min(len(holes), int(rng.integers(2, 4)))
        rest = sorted(rng.choice(np.array(holes[1:]), count - 1, replace=False).tolist())
        sides.append([holes[0], *rest])
    used = tuple(sorted(int(h) for side in sides for h in side))
    material = "steel" if rng.random() < 0.5 else "titanium"
    other_material = {"steel": "titanium", "titanium": "steel"}[material]
    combination = rng.random() < 0.5
    pre_bent = rng.random() < 0.5
    kind = rng.choice(["plain", "s", "loose"], p=[0.5, 0.3, 0.2])
    directions = rng.normal(size=(2, 3))
    turn, shift = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    bare = rng.random() < 0.2
    innermost = [index for index, hole in enumerate(used) if hole in (sides[0][0], sides[1][0])]
    return Draw(
        seed=seed,
        material=material,
        screw_material=material if rng.random() < 0.65 else other_material,
        num_holes=num_holes,
        pitch=float(rng.uniform(14.5, 18.5)),
        width=float(rng.uniform(11.0, 14.0)),
        thickness=float(rng.uniform(2.8, 4.6)),
        hole_offset=float(rng.uniform(1.2, 1.8)) if combination else 0.0,
        flare=float(rng.uniform(1.2, 1.8)) if pre_bent and rng.random() < 0.5 else 1.0,
        bow_deg=float(rng.uniform(-8.0, 8.0)) if pre_bent else 0.0,
        twist_deg=float(rng.uniform(-8.0, 8.0)) if pre_bent else 0.0,
        holes_used=used,
        loose=int(rng.choice(innermost)) if kind == "loose" and min(len(s) for s in sides) > 1 else None,
        tilt_deg=float(rng.uniform(3.0, 8.0)) if rng.random() < 0.5 else 0.0,
        heads=bool(rng.random() < 0.3),
        bend_deg=float(rng.uniform(-2.4, 2.4)) * (0.3 if kind == "s" else 1.0),
        s_bend_deg=float(rng.uniform(0.8, 2.4)) if kind == "s" else 0.0,
        torsion_deg=float(rng.uniform(-1.5, 1.5)),
        lateral_deg=float(rng.uniform(-0.3, 0.3)),
        turn_deg=tuple((float(rng.uniform(0.2, 1.5)) * turn).tolist()),
        shift=tuple((float(rng.uniform(0.2, 2.0)) * shift).tolist()),
        scanner="extremity" if rng.random() < 0.7 else "c-arm",
        azimuth_deg=round(float(rng.uniform(0.0, 180.0)), 1),
        kvp=int(rng.choice(_KILOVOLTS)),
        water_radius=0.0 if bare else float(rng.uniform(40.0, 52.0)),
        bone_radius=float(rng.uniform(10.0, 14.0)),
        cortex=float(rng.uniform(3.0, 6.0)),
        marrow=bool(rng.random() < 0.5),
        focal_spot=float(rng.uniform(0.2, 0.6)),
        panel=PanelRecipe(
            half_contrast_lp_mm=float(rng.uniform(1.2, 2.4)),
            glare=float(rng.uniform(0.0, 0.12)),
            open_beam=float(rng.uniform(2400.0, 3600.0)),
            photons=float(np.exp(rng.uniform(math.log(8e3), math.log(6e4)))),
            electronic_noise=float(rng.uniform(1.0, 4.0)),
        ),
        scatter_to_primary=float(rng.uniform(0.1, 0.8)),
    )


def random_case(
    seed: int | Draw, *, views: ViewSet = "neighbours", elastic: bool = False, counts: Tensor | None = None
) -> SimulatedCase:
    """A case of the population: images and ground truth.

    Args:
        seed: Seed of the case, or its drawn parameters, which may have been changed.
        views: "neighbours": three neighbouring views, one for each focal spot; "around": six around the limb; "both":
            these nine, in this order; "spread": three around the limb; "many": 24 around the limb.
        elastic: A force on the upper fragment bends the plate by finite elements; the load that it carries is then
            known. Otherwise the plate bends by the drawn angles.
        counts: Cached images of the case: simulating them takes seconds.
    """
    draw = seed if isinstance(seed, Draw) else draw_case(seed)
    phantom, construct = random_specimen(draw), None
    if elastic:
        construct = ElasticConstruct(phantom)
        load = _force(draw, construct)
        phantom = replace(phantom, recipe=phantom.recipe.model_copy(update={"configurations": {"loaded": load}}))
    geometry, spectrum = view_geometry(draw, views), tungsten_spectrum(draw.kvp)
    return SimulatedCase.of(phantom, geometry, spectrum, construct=construct, counts=counts)


def random_specimen(draw: Draw) -> Specimen:
    """The specimen of drawn parameters, with a recipe that bends the plate by the drawn angles."""
    plate = {
        "length": quantity(draw.length, "mm"),
        "width": quantity(draw.width, "mm"),
        "thickness": quantity(draw.thickness, "mm"),
        "holes": draw.num_holes,
        "hole_offset": quantity(draw.hole_offset, "mm"),
        "bow": quantity(draw.bow_deg, "deg"),
        "twist": quantity(draw.twist_deg, "deg"),
        "flare": draw.flare,
    }
    bone = {
        "axis": quantity((0.0, draw.bone_y, 0.0), "mm"),
        "outer_radius": quantity(draw.bone_radius, "mm"),
        "inner_radius": quantity(draw.bone_radius - draw.cortex, "mm"),
        "gap": quantity(_GAP_MM, "mm"),
        "reach": "160 mm",
        "marrow": "cancellous_bone" if draw.marrow else None,
    }
    water = {"radius": quantity(draw.water_radius, "mm"), "half_length": "170 mm", "material": "water"}
    beads = [quantity(bead, "mm") for bead in _beads(draw).tolist()]
    recipe = Recipe.of(
        {
            "implant": {"plate": plate, "material": draw.material},
            "screws": {
                "material": draw.screw_material,
                "heads": {} if draw.heads else None,
                "loose": () if draw.loose is None else (draw.loose,),
            },
            "limb": {"bone": bone, "tissue": water if draw.water_radius else None, "beads": beads},
            "configurations": {"loaded": _angles(draw)},
            "tube": {"voltage": quantity(draw.kvp, "kV"), "focal_spot": quantity(draw.focal_spot, "mm")},
            "panel": draw.panel,
            "scatter_to_primary": draw.scatter_to_primary,
            "seed": draw.seed,
        }
    )
    assert recipe.implant.plate is not None  # as above
    return specimen(recipe, implant=parametric_plate(recipe.implant.plate), screws=_screws(draw))


def view_geometry(draw: Draw, views: ViewSet) -> ConeBeamGeometry:
    """Geometry of a case's views, cropped to the part of the panel behind the limb."""
    spots = {"T1": 120.0, "T2": 0.0, "T3": -120.0}
    scanner = MultisourceScanner()
    if draw.scanner == "c-arm":
        spots = {"T1": 40.0, "T2": 0.0, "T3": -40.0}
        scanner = replace(scanner, sad=620.0, sdd=1050.0)
    neighbours = [draw.azimuth_deg + step for step in range(3)] if views in ("neighbours", "both") else []
    around = [draw.azimuth_deg + 30.0 * step + 10.0 for step in range(6)] if views in ("around", "both") else []
    around += [draw.azimuth_deg + 60.0 * step for step in range(3)] if views == "spread" else []
    around += [draw.azimuth_deg + 15.0 * step for step in range(24)] if views == "many" else []
    angles = [*neighbours, *around]
    names = [f"T{1 + index % 3}" for index in range(len(angles))]
    scanners = [
        replace(scanner, num_views=1, start_deg=angle, phase_deg=angle, firing_order=(name,), source_z_mm=spots)
        for angle, name in zip(angles, names, strict=True)
    ]
    geometries = [single_view.geometry() for single_view in scanners]
    cols = 320 if draw.scanner == "c-arm" else 256
    first_col = (scanner.det_shape[1] - cols) // 2
    joined = ConeBeamGeometry(
        torch.cat([g.projection_matrices for g in geometries]),
        scanner.det_shape,
        scanner.pixel_spacing,
        sources=names,
        angles_deg=angles,
    )
    return joined.crop(slice(32, scanner.det_shape[0] - 32), slice(first_col, first_col + cols))


def _contour(draw: Draw) -> RodMotion:
    """Motion from the straight plate to the undeformed (contoured) one."""
    rates = torch.deg2rad(torch.tensor([draw.bow_deg, 0.0, draw.twist_deg], dtype=torch.float64)) / draw.length
    return RodMotion(lambda z: rates.expand(len(z), 3), (-draw.length / 2, draw.length / 2))


def _held(draw: Draw) -> list[float]:
    """Heights of the screws that hold, mm."""
    return [draw.hole_heights[hole] for number, hole in enumerate(draw.holes_used) if number != draw.loose]


def _angles(draw: Draw) -> LoadRecipe:
    """Bending between the innermost screws that hold, and the misalignment."""
    low, high = max(z for z in _held(draw) if z < 0), min(z for z in _held(draw) if z > 0)
    angles = {
        "bend": draw.bend_deg,
        "lateral": draw.lateral_deg,
        "torsion": draw.torsion_deg,
        "s_bend": draw.s_bend_deg,
    }
    return LoadRecipe.of(
        {
            **{name: quantity(angle, "deg") for name, angle in angles.items()},
            "zone": quantity((high - low) / 2, "mm"),
            "center": quantity((low + high) / 2, "mm"),
            **_misalignment(draw),
        }
    )


def _misalignment(draw: Draw) -> dict[str, str]:
    return {"rotation": quantity(draw.turn_deg, "deg"), "translation": quantity(draw.shift, "mm")}


def _force(draw: Draw, construct: ElasticConstruct) -> LoadRecipe:
    """A force on the upper fragment, mostly along the bone, that stresses the plate to a random share of its yield."""
    rng = np.random.default_rng([draw.seed, 22])
    direction = np.array([*rng.normal(scale=0.15, size=2), -1.0])
    at = (float(rng.normal(scale=4.0)), draw.bone_y + float(rng.uniform(-15.0, 15.0)), float(rng.uniform(40.0, 120.0)))
    unit = torch.from_numpy(direction / np.linalg.norm(direction))
    amounts = construct.amounts(unit, torch.tensor(at, dtype=torch.float64))
    surface = torch.from_numpy(np.array(construct.specimen.implant.vertices))
    stress = float(von_mises(construct.element.stress(surface, amounts)).quantile(_HIGHEST))
    newton = float(rng.uniform(*_STRESSED)) * construct.element.constants.yield_stress / stress
    force = quantity((newton * unit).tolist(), "N")
    return LoadRecipe.of({"force": force, "at": quantity(at, "mm"), **_misalignment(draw)})


def _screws(draw: Draw) -> list[Screw]:
    """Screws of the undeformed plate, of random length, radius and tilt."""
    rng = np.random.default_rng([draw.seed, 21])
    contour, screws = _contour(draw), []
    for number, hole in enumerate(draw.holes_used):
        direction = rng.normal(size=2)
        tilt = math.radians(rng.uniform(0.4, 1.0) * draw.tilt_deg) * direction / np.linalg.norm(direction)
        offset = draw.hole_offset if rng.random() < 0.5 else -draw.hole_offset
        length, radius = float(rng.uniform(26.0, 40.0)), float(rng.uniform(1.6, 2.2))
        axis = torch.tensor([math.sin(tilt[0]), -1.0, math.sin(tilt[1])], dtype=torch.float64)
        head = torch.tensor([0.0, draw.thickness / 2, offset], dtype=torch.float64)
        ends = torch.stack([head, head + length * axis / axis.norm()])
        frame = contour.frames(torch.tensor([draw.hole_heights[hole]], dtype=torch.float64))[0]
        start, end = ends @ frame[:3, :3].T + frame[:3, 3]
        screws.append(Screw(tuple(start.tolist()), tuple(end.tolist()), radius, draw.screw_material, f"screw{number}"))
    return screws


def _beads(draw: Draw) -> Tensor:
    """Centres (8, 3) of beads beside the undeformed plate, near and beyond its outermost screws."""
    group = torch.tensor([[11.0, 2.0, 4.0], [-11.0, -2.0, 8.0], [10.0, -3.0, 14.0], [-10.0, 3.0, 19.0]]).double()
    low, high = (draw.hole_heights[hole] for hole in (draw.holes_used[0], draw.holes_used[-1]))
    below = group * torch.tensor([1.0, 1.0, -1.0]) + torch.tensor([0.0, 0.0, low + 4.0])
    above = group * torch.tensor([-1.0, 1.0, 1.0]) + torch.tensor([0.0, 0.0, high - 4.0])
    return _contour(draw)(torch.cat([below, above]))

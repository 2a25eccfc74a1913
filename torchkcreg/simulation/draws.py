"""Random parameters of a simulated case: plate, screws, limb, tube voltage, scanner and load, drawn by a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .hardware import hole_positions
from .scanner import DetectorModel

_KILOVOLTS = (70, 80, 90, 100, 110, 120)


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
        detector: Detector model.
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
    detector: DetectorModel

    @property
    def length(self) -> float:
        """Length of the plate, mm."""
        return self.num_holes * self.pitch + 8.0

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
    sides_of_scatter = rng.random() < 0.5
    scatter = float(rng.uniform(0.1, 0.5))
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
        water_radius=0.0 if bare else float(rng.uniform(32.0, 48.0)),
        bone_radius=float(rng.uniform(10.0, 14.0)),
        cortex=float(rng.uniform(3.0, 6.0)),
        marrow=bool(rng.random() < 0.5),
        detector=DetectorModel(
            scatter_fraction=scatter if sides_of_scatter else 0.2 * scatter,
            scatter_removed=0.0 if sides_of_scatter else float(rng.uniform(0.1, 0.4)),
            scatter_sigma_mm=float(rng.uniform(15.0, 40.0)),
            psf_sigma_mm=float(rng.uniform(0.12, 0.3)),
            glare_share=float(rng.uniform(0.0, 0.15)),
            glare_sigma_mm=float(rng.uniform(0.5, 1.2)),
            open_beam=float(rng.uniform(2400.0, 3600.0)),
            photons=float(np.exp(rng.uniform(math.log(8e3), math.log(6e4)))),
            electronic_noise=float(rng.uniform(1.0, 4.0)),
        ),
    )

"""Random weight-bearing cases with clinically varied plates, screws, limbs, spectra, scanners and loads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner, fit_rigid, rigid_matrix
from torchkcreg.implant import Screw
from torchkcreg.physics import tungsten_spectrum

from .cases import BEAD_RADIUS, FRAGMENTS, GAP, SimulatedCase, fragment_at
from .draws import Draw, draw_case
from .elastic import ElasticMotion, Fragments, elastic_motion
from .hardware import flared, locking_plate, mapped
from .loads import Load, RodMotion
from .parts import Part
from .scanner import simulate_projections
from .solids import Cylinder, Sphere, Tube

PlateMotion = RodMotion | ElasticMotion
ViewSet = Literal["neighbours", "around", "both", "spread", "many"]
_SOFTENING_MM = 4.0  # length over which the plate's curvature rises from zero next to a holding screw


def random_case(
    seed: int | Draw, *, views: ViewSet = "neighbours", elastic: bool = False, counts: Tensor | None = None
) -> SimulatedCase:
    """A case of the population: images and ground truth.

    Args:
        seed: Seed of the case, or its drawn parameters, which may have been changed.
        views: "neighbours": three neighbouring views, one for each focal spot; "around": six around the limb; "both":
            these nine, in this order; "spread": three around the limb; "many": 24 around the limb.
        elastic: The plate bends by finite elements under loads at its screws, which are then known. Otherwise it bends
            as a rod with a drawn curvature.
        counts: Cached images of the case: simulating them takes seconds.
    """
    draw = seed if isinstance(seed, Draw) else draw_case(seed)
    rest, loaded = motions(draw)
    straight, carried = _straight_plate(draw), None
    if elastic:
        rng = np.random.default_rng([draw.seed, 22])
        pose = _misalignment(draw)
        loaded, carried = elastic_motion(rest, mapped(straight, rest), draw.material, _fragments(draw), pose, rng)

    def deform(points: Tensor) -> Tensor:
        return loaded(rest.straightened(points)).to(points.dtype)

    listed, in_beam = _screws(draw, rest, loaded)
    beads = _bead_positions(draw)
    parts = [Part("plate", mapped(straight, loaded), draw.material, inside=_tissue(draw)), *in_beam]
    parts += _limb(draw, loaded)
    parts += [
        Part(f"bead{n}", Sphere(center, BEAD_RADIUS), "steel", inside=_tissue(draw))
        for n, center in enumerate(loaded(beads))
    ]
    geometry = view_geometry(draw, views)
    spectrum = tungsten_spectrum(draw.kvp)
    if counts is None:
        counts = simulate_projections(geometry, parts, spectrum, detector=draw.detector, seed=draw.seed)
    return SimulatedCase(
        geometry=geometry,
        implant=mapped(straight, rest),
        implant_material=draw.material,
        screws=listed,
        beads_before=rest(beads),
        beads_after=loaded(beads),
        deform=deform,
        intensity=counts,
        open_beam=draw.detector.open_beam,
        saturation=draw.detector.saturation,
        spectrum=spectrum,
        load=Load(bend_deg=draw.bend_deg, s_bend_deg=draw.s_bend_deg, torsion_deg=draw.torsion_deg),
        parts=parts,
        carried=carried,
    )


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


def motions(draw: Draw) -> tuple[RodMotion, PlateMotion]:
    """Motions from the straight plate to the undeformed (contoured) plate and to the loaded plate."""
    half = draw.length / 2
    bow = torch.deg2rad(torch.tensor([draw.bow_deg, 0.0, draw.twist_deg], dtype=torch.float64)) / draw.length
    held = [z for i, z in enumerate(draw.hole_heights[hole] for hole in draw.holes_used) if i != draw.loose]
    low, high = max(z for z in held if z < 0), min(z for z in held if z > 0)
    middle, reach = (low + high) / 2, (high - low) / 2

    def loaded(z: Tensor) -> Tensor:
        relative = (z - middle) / reach
        inside = ((reach - (z - middle).abs()) / _SOFTENING_MM).clamp(0, 1) / (2 * reach - _SOFTENING_MM)
        angles = (draw.bend_deg, draw.lateral_deg, draw.torsion_deg)
        bend, lateral, torsion = (math.radians(angle) * inside for angle in angles)
        bend = bend - 4 * math.radians(draw.s_bend_deg) * relative * inside
        return torch.stack([bend, lateral, torsion], dim=-1) + bow

    stretch = (-half, half)
    rest = RodMotion(lambda z: bow.expand(len(z), 3), stretch)
    nodes = torch.cartesian_prod(*(torch.linspace(-x, x, n).double() for x, n in zip((6.0, 2.0, half), (2, 2, 65))))
    common = fit_rigid(rest(nodes), RodMotion(loaded, stretch)(nodes))
    return rest, RodMotion(loaded, stretch, _misalignment(draw) @ torch.linalg.inv(common))


def _misalignment(draw: Draw) -> Tensor:
    turn = torch.deg2rad(torch.tensor(draw.turn_deg, dtype=torch.float64))
    return rigid_matrix(turn, torch.tensor(draw.shift, dtype=torch.float64))


def _fragments(draw: Draw) -> Fragments:
    """The two bone fragments and the holding screws. The S-bend is a relative shift of the fragments."""
    heights = [draw.hole_heights[hole] for index, hole in enumerate(draw.holes_used) if index != draw.loose]
    arm = min(z for z in heights if z > 0) - max(z for z in heights if z < 0)
    shift = (0.0, math.radians(draw.s_bend_deg) * arm / 4, 0.0)
    return Fragments(heights, (draw.bend_deg, draw.lateral_deg, draw.torsion_deg), shift)


def _straight_plate(draw: Draw) -> trimesh.Trimesh:
    plate = locking_plate(
        length=draw.length,
        width=draw.width,
        thickness=draw.thickness,
        num_holes=draw.num_holes,
        hole_radius=2.4,
        hole_offset=draw.hole_offset,
        max_edge=2.0,
    )
    return flared(plate, draw.length, draw.flare)


def _screws(draw: Draw, rest: RodMotion, loaded: PlateMotion) -> tuple[list[Screw], list[Part]]:
    """List of the screws without load, and their loaded parts in the beam, with heads that are not in the list."""
    rng = np.random.default_rng([draw.seed, 21])
    listed: list[Screw] = []
    parts = []
    top, tissue = draw.thickness / 2, _tissue(draw)
    for number, hole in enumerate(draw.holes_used):
        height = draw.hole_heights[hole]
        z = torch.tensor([height], dtype=torch.float64)
        direction = rng.normal(size=2)
        tilt = math.radians(rng.uniform(0.4, 1.0) * draw.tilt_deg) * direction / np.linalg.norm(direction)
        offset = draw.hole_offset if rng.random() < 0.5 else -draw.hole_offset
        length, radius = float(rng.uniform(26.0, 40.0)), float(rng.uniform(1.6, 2.2))
        axis = torch.tensor([math.sin(tilt[0]), -1.0, math.sin(tilt[1])], dtype=torch.float64)
        head = torch.tensor([0.0, top, offset], dtype=torch.float64)
        tip = head + length * axis / axis.norm()
        ends = torch.stack([head, tip])
        fragment = fragment_at(height)
        before, after = (motion.frames(z)[0] for motion in (rest, loaded))
        start, end = ends @ before[:3, :3].T + before[:3, 3]
        listed.append(Screw(tuple(start.tolist()), tuple(end.tolist()), radius, draw.screw_material, f"screw{number}"))
        shaft = ends @ after[:3, :3].T + after[:3, 3]
        parts.append(
            Part(f"screw{number}", Cylinder(shaft[0], shaft[1], radius), draw.screw_material, (fragment,), tissue)
        )
        if draw.heads:
            cap = torch.stack([head, head + torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)])
            cap = cap @ after[:3, :3].T + after[:3, 3]
            parts.append(Part(f"head{number}", Cylinder(cap[0], cap[1], 1.7 * radius), draw.screw_material, (), tissue))
    return listed, parts


def _limb(draw: Draw, loaded: PlateMotion) -> list[Part]:
    """The two bone fragments, each moved with its screws, and the water around them."""
    depth = -(draw.thickness / 2 + 1.5 + draw.bone_radius)
    parts, tissue = [], _tissue(draw)
    for fragment, side in zip(FRAGMENTS, (-1.0, 1.0), strict=True):
        heights = [draw.hole_heights[hole] for hole in draw.holes_used]
        held = [z for i, z in enumerate(heights) if z * side > 0 and i != draw.loose]
        points = torch.tensor([[x, y, z] for z in held for x in (-3.0, 3.0) for y in (0.0, depth)]).double()
        motion = fit_rigid(points, loaded(points))
        near = torch.tensor([0.0, depth, side * GAP / 2], dtype=torch.float64)
        far = torch.tensor([0.0, depth, side * 160.0], dtype=torch.float64)
        bone = Tube(near, far, draw.bone_radius, draw.bone_radius - draw.cortex).moved(motion)
        parts.append(Part(fragment, bone, "cortical_bone", inside=tissue))
        if draw.marrow:
            core = Cylinder(near, far, draw.bone_radius - draw.cortex - 1e-3).moved(motion)
            parts.append(Part(f"{fragment} marrow", core, "cancellous_bone", inside=tissue))
    if tissue is not None:
        ends = torch.tensor([[0.0, depth, -170.0], [0.0, depth, 170.0]], dtype=torch.float64)
        parts.append(Part(tissue, Cylinder(ends[0], ends[1], draw.water_radius), "water"))
    return parts


def _tissue(draw: Draw) -> str | None:
    return "tissue" if draw.water_radius else None


def _bead_positions(draw: Draw) -> Tensor:
    """Centres (8, 3) of beads beside the straight plate, near and beyond its outermost screws."""
    group = torch.tensor([[11.0, 2.0, 4.0], [-11.0, -2.0, 8.0], [10.0, -3.0, 14.0], [-10.0, 3.0, 19.0]]).double()
    low, high = (draw.hole_heights[hole] for hole in (draw.holes_used[0], draw.holes_used[-1]))
    below = group * torch.tensor([1.0, 1.0, -1.0]) + torch.tensor([0.0, 0.0, low + 4.0])
    above = group * torch.tensor([-1.0, 1.0, 1.0]) + torch.tensor([0.0, 0.0, high - 4.0])
    return torch.cat([below, above])

"""Register one simulated case of the population and measure its errors in mm and the registration's diagnostics."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchkcreg.deformation import Deformation, FiniteElementDeformation
from torchkcreg.evaluation import bb_rmse
from torchkcreg.geometry import ConeBeamGeometry, fit_rigid, transform_points
from torchkcreg.implant import find_holes
from torchkcreg.io.arrays import read_array, write_array
from torchkcreg.mechanics import CarriedLoad
from torchkcreg.registration import RegisteredImplant, RegistrationConfig, RegistrationData, register
from torchkcreg.scene import ViewMotions
from torchkcreg.simulation import Draw, SimulatedCase, draw_case, random_case

from .capture import registration_inputs
from .sweeps import Job, Row

ERRORS = {"detector": 0.3, "source": 0.2, "limb": 0.3}  # pixels, mm, mm
WIDTHS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 1.96, 2.25, 2.5, 2.75, 3.0, 3.5, 4.0)
MOMENTS = ("true", "found", "std")


def wrong_geometry(geometry: ConeBeamGeometry, nodes: Tensor, error: str, seed: int) -> ConeBeamGeometry:
    """A wrong geometry to be given to a registration in place of the true one.

    The errors are independent between views and their mean over the views is zero. A common error would only move the
    implant, which the images cannot distinguish from a displaced scanner.

    Args:
        geometry: True geometry of the images.
        nodes: World positions (N, 3) of the implant's nodes.
        error: "detector": shift by 0.3 pixels along rows and columns; "source": shift by 0.2 mm along each axis;
            "limb": rigid motion between views that moves the nodes by 0.3 mm RMS; "all" of them; "none".
        seed: Seed of the random errors.

    Raises:
        ValueError: If the error has none of these names.
    """
    if error not in ("none", "all", *ERRORS):
        raise ValueError(f"error must be one of none, {', '.join(ERRORS)}, all, got {error!r}")
    rng = np.random.default_rng([seed, 77])
    number = geometry.num_views
    drawn = [torch.from_numpy(rng.normal(size=(number, n))) for n in (2, 3, 6)]
    pixels, shifts, motions = (x - x.mean(0) for x in drawn)
    matrices = geometry.projection_matrices.clone()
    if error in ("detector", "all"):
        matrices[:, :2] += ERRORS["detector"] * pixels[..., None] * matrices[:, 2:]
    if error in ("source", "all"):
        distances = geometry.detector_distances.tolist()
        moved = zip(matrices, distances, ERRORS["source"] * shifts, strict=True)
        matrices = torch.stack([with_source(*view) for view in moved])
    if error in ("limb", "all"):
        limb = ViewMotions(nodes, number, 1.0)
        # 5, not 6 motions: a rotation about its long axis hardly moves a plate
        limb.values.copy_(ERRORS["limb"] / math.sqrt(5) * motions)
        matrices = matrices @ limb.matrices()
    return ConeBeamGeometry(
        matrices,
        geometry.det_shape,
        geometry.pixel_spacing,
        sources=geometry.sources,
        angles_deg=geometry.angles_deg,
    )


def with_source(matrix: Tensor, distance: float, shift: Tensor) -> Tensor:
    """Projection matrix (3, 4) with the source moved by `shift` (3,) mm; the detector at `distance` stays in place."""
    inverse = torch.linalg.inv(matrix[:, :3])
    source = shift - inverse @ matrix[:, 3]
    inverse[:, 2] -= shift / distance
    rotated = torch.linalg.inv(inverse)
    return torch.cat([rotated, -(rotated @ source)[:, None]], dim=1)


def simulated(job: Job) -> Row:
    """Simulate and register one case, and return its row.

    Args:
        job: `seed` of the case; `views` ("neighbours", "around", "both", "spread" or "many"); `elastic`: the plate
            bends under known loads; `known`: screws and spectrum are given to the registration; `geometry`: error of
            the geometry, see `wrong_geometry`; `images`: "own", or wrong ones: those of another case, "mirrored",
            "turned"; `options` of the registration; `cache`: folder of cached images.
    """
    draw = draw_case(job["seed"])
    return registered(job, draw, made_case(draw, job["views"], job["elastic"], job["cache"]))


def registered(job: Job, draw: Draw, case: SimulatedCase, *, chosen: list[int] | None = None) -> Row:
    """Register a case to all of its views, or to the chosen ones, and return its row.

    With wrong images (not "own") there is no correct result: the worst error is infinite.
    """
    config = RegistrationConfig(material=case.implant_material, **job["options"])
    data, cloud, screws = registration_inputs(case, config.pitch_mm)
    if job["images"] != "own":
        data = replace(data, **_unrelated(draw, data, job["images"]))
    nodes = cloud.coarsened(8).points.double()
    truth = case.deform(nodes)
    data = replace(data, geometry=wrong_geometry(data.geometry, truth, job["geometry"], draw.seed))
    if chosen is not None:
        data = data.select(chosen)
    start = time.perf_counter()
    result = register(
        cloud,
        data,
        config,
        spectrum=case.spectrum if job["known"] else None,
        components=screws if job["known"] else (),
        holes=find_holes(case.implant),
    )
    no_answer = {} if job["images"] == "own" else {"worst": math.inf}
    return {
        "seed": draw.seed,
        **errors_of(result.implants[0], case, nodes, truth),
        **no_answer,
        "gc": round(float(result.gc.mean()), 4),
        **{name: value for name, value in result.diagnostics.items() if name != "gc"},
        "gc_views": result.diagnostics["gc"],
        "status": result.status,
        "warnings": "; ".join(result.warnings),
        "seconds": round(time.perf_counter() - start, 1),
        "azimuth": draw.azimuth_deg,
        "scatter": round(draw.scatter_to_primary, 3),
        "kind": f"{draw.material} {draw.screw_material} {draw.scanner} {draw.kvp} kV water {draw.water_radius:.0f}",
        "physics": " ".join(f"{name}={value:.3f}" for name, value in result.intensity.items()),
        **load_errors(case, result.implants[0].deformation),
    }


def made_case(draw: Draw, views: Any, elastic: bool, cache: str) -> SimulatedCase:
    """The simulated case of a draw. Its images are read from, or written to, the cache folder if one is given."""
    cached = Path(cache) / f"{'elastic-' if elastic else ''}{views}-{draw.seed}.npy" if cache else None
    counts = read_array(cached) if cached is not None and cached.exists() else None
    case = random_case(draw, views=views, elastic=elastic, counts=counts)
    if cached is not None and counts is None:
        write_array(cached, case.intensity)
    return case


def _unrelated(draw: Draw, data: RegistrationData, images: str) -> dict[str, Any]:
    """Wrong line integrals, mask and geometry: mirrored, turned by 180 degrees, or those of another case."""
    if images == "mirrored":
        return {"line_integrals": data.line_integrals.flip(-1), "mask": data.mask.flip(-1)}
    if images == "turned":
        return {"line_integrals": data.line_integrals.flip(-2, -1), "mask": data.mask.flip(-2, -1)}
    other_case = random_case(draw_case(draw.seed + 1000))
    data = other_case.data()
    return {"line_integrals": data.line_integrals, "mask": data.mask, "geometry": data.geometry}


def errors_of(implant: RegisteredImplant, case: SimulatedCase, nodes: Tensor, truth: Tensor) -> Row:
    """Errors in mm: RMS of beads, of nodes, of nodes after rigid alignment and along the rays; the worst figure."""
    estimated = implant.warp(nodes)
    errors, zeros = estimated - truth, torch.zeros_like(nodes)
    ray = case.geometry.source_positions.double().mean(0) - nodes.mean(0)
    beads = float(bb_rmse(implant.warp(case.beads_before.double()), case.beads_after.double()))
    node, largest = float(bb_rmse(errors, zeros)), float(errors.norm(dim=-1).max()) / 3
    figures = {
        "beads": beads,
        "nodes": node,
        "shape": float(bb_rmse(transform_points(fit_rigid(estimated, truth), estimated), truth)),
        "largest_third": largest,
        "worst": max(beads, node, largest),
        "depth": float((errors @ (ray / ray.norm())).square().mean().sqrt()),
    }
    return {name: round(value, 4) for name, value in figures.items()} | {
        "coverage": coverage_of(implant, case, nodes, errors)
    }


def coverage_of(implant: RegisteredImplant, case: SimulatedCase, nodes: Tensor, errors: Tensor) -> dict[str, list]:
    """Share of true positions within each multiple (`WIDTHS`) of the stated standard deviation."""
    deviations = implant.deviations
    if deviations is None:
        return {}
    beads = case.beads_before.double()
    off = {"nodes": (nodes, errors), "beads": (beads, implant.warp(beads) - case.beads_after.double())}
    _, axes = torch.linalg.eigh(torch.outer(deviations.depth, deviations.depth))
    parts = {"lateral": (axes[:, 0], axes[:, 1]), "depth": (deviations.depth,)}
    shares = {}
    for name, (points, error) in off.items():
        spread = deviations.covariance(points)
        for part, directions in parts.items():
            sizes = [(error @ d).abs() / torch.einsum("i,nij,j->n", d, spread, d).sqrt() for d in directions]
            size = torch.cat(sizes)
            shares[f"{name} {part}"] = [round(float((size <= width).double().mean()), 4) for width in WIDTHS]
    return shares


def load_errors(case: SimulatedCase, deformation: Deformation) -> Row:
    """Bending moments in N mm: true value, estimate and standard deviation.

    They are evaluated midway between the fragments and where the true moment is largest, about the axis with the larger
    true moment.
    """
    carried = case.carried
    if carried is None or not isinstance(deformation, FiniteElementDeformation):
        return {}
    estimated = CarriedLoad.of(
        deformation.superelement, deformation.amounts.detach(), deformation.covariance, deformation.expected
    )
    # the axes of the two lattices may have opposite signs
    signs = (estimated.axes @ carried.axes.mT).diagonal().sign()[:2]
    true, moments, std = (
        carried.section_loads[:, 3:5],
        signs * estimated.section_loads[:, 3:5],
        estimated.section_std[:, 3:5],
    )
    size = carried.hold_loads.abs().amax(0)
    used = carried.hold_heights[(carried.hold_loads.abs() > 1e-3 * size).any(1)]
    middle = carried.heights[-1] / 2
    gap = (used[used < middle].max() + used[used > middle].min()) / 2
    places = {"gap": int((carried.heights - gap).abs().argmin()), "largest": int(true.abs().amax(1).argmax())}
    rows: Row = {}
    for name, index in places.items():
        axis = int(true[index].abs().argmax())
        values = (float(x[index, axis]) for x in (true, moments, std))
        rows |= {f"{name}_{key}": round(value) for key, value in zip(MOMENTS, values, strict=True)}
    return rows

"""Registrations of a random population of simulated cases: errors, and what the verdict missed of them.

    python benchmarks/population.py                      # 40 cases, three neighbouring views, about 20 minutes
    python benchmarks/population.py --views around --known
    python benchmarks/population.py --elastic --known --options '{"deformation": "fe"}'  # loads are known, too

Rows are written as they come; a run that was broken off goes on where it stopped. The cases are those of
`torchkcreg.simulation.random_case`; two are registered at a time, with a thread each.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import matplotlib  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from matplotlib.ticker import NullFormatter  # noqa: E402
from tqdm import tqdm  # noqa: E402

from torchkcreg.deformation import Deformation, FiniteElementDeformation  # noqa: E402
from torchkcreg.evaluation import bb_rmse  # noqa: E402
from torchkcreg.experiments.capture import registration_inputs  # noqa: E402
from torchkcreg.geometry import ConeBeamGeometry, fit_rigid, transform_points  # noqa: E402
from torchkcreg.implant import find_holes  # noqa: E402
from torchkcreg.mechanics import CarriedLoad  # noqa: E402
from torchkcreg.physics import line_integrals_from_intensity  # noqa: E402
from torchkcreg.registration import (  # noqa: E402
    Callback,
    RegisteredImplant,
    RegistrationConfig,
    RegistrationData,
    Trainer,
    build_scene,
)
from torchkcreg.scene import ViewMotions  # noqa: E402
from torchkcreg.simulation import Draw, SimulatedCase, draw_case, random_case  # noqa: E402

WRONG_MM, RIGHT_MM = 0.15, 0.10
ERRORS = {"detector": 0.3, "source": 0.2, "limb": 0.3}  # of a geometry: pixels, mm, mm
WIDTHS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 1.96, 2.25, 2.5, 2.75, 3.0, 3.5, 4.0)
_MOMENTS = ("true", "found", "std")
Job = tuple[int, str, bool, bool, dict[str, Any], str, str, str]


class _ErrorsOfStages(Callback):
    """Node RMSE after each stage, and the loss there."""

    def __init__(self, truth: torch.Tensor) -> None:
        self.truth = truth
        self.errors: list[str] = []

    def on_stage_end(self, trainer: Trainer, index: int, stage: Any) -> None:
        error = float(bb_rmse(trainer.scene.assemblies[0].nodes(), self.truth))
        self.errors.append(f"{error:.3f}/{trainer.history[-1]['loss']:.4f}")


def unrelated_images(case: SimulatedCase, draw: Draw, data: RegistrationData, images: str) -> dict[str, Any]:
    """Line integrals and geometry of images that do not show the case's implant where the geometry has it."""
    if images == "mirrored":
        return {"line_integrals": data.line_integrals.flip(-1), "mask": data.mask.flip(-1)}
    if images == "turned":
        return {"line_integrals": data.line_integrals.flip(-2, -1), "mask": data.mask.flip(-2, -1)}
    other = random_case(draw_case(draw.seed + 1000))
    lines, mask = line_integrals_from_intensity(other.intensity.float(), other.open_beam)
    return {"line_integrals": lines, "mask": mask, "geometry": other.geometry}


def wrong_geometry(geometry: ConeBeamGeometry, nodes: torch.Tensor, error: str, seed: int) -> ConeBeamGeometry:
    """The geometry that a registration is told where the scan was made with another.

    Errors are independent in each view and sum to nothing over all: what views have in common moves the implant, which
    no image tells from a scanner that stands elsewhere.

    Args:
        geometry: Of the images.
        nodes: World positions (N, 3) of the implant.
        error: "detector": 0.3 pixels along rows and columns; "source": 0.2 mm along each axis; "limb": a rigid motion
            between views that moves nodes by 0.3 mm, root mean square; "all" of them.
        seed: Of the random numbers.
    """
    rng = np.random.default_rng([seed, 77])
    number = geometry.num_views
    drawn = [torch.from_numpy(rng.normal(size=(number, n))) for n in (2, 3, 6)]
    pixels, shifts, motions = (x - x.mean(0) for x in drawn)
    matrices = geometry.projection_matrices.clone()
    if error in ("detector", "all"):
        matrices[:, :2] += ERRORS["detector"] * pixels[..., None] * matrices[:, 2:]
    if error in ("source", "all"):
        distances = geometry.detector_distances
        for view, shift in enumerate(ERRORS["source"] * shifts):
            matrices[view] = with_source(matrices[view], float(distances[view]), shift)
    if error in ("limb", "all"):
        moved = ViewMotions(nodes, number, 1.0)
        moved.values.copy_(ERRORS["limb"] / math.sqrt(5) * motions)  # about its long axis a plate hardly moves
        matrices = matrices @ moved.matrices()
    return ConeBeamGeometry(
        matrices,
        geometry.det_shape,
        geometry.pixel_spacing,
        sources=geometry.sources,
        angles_deg=geometry.angles_deg,
    )


def with_source(matrix: torch.Tensor, distance: float, shift: torch.Tensor) -> torch.Tensor:
    """The projection matrix (3, 4) after its source has moved by (3,) mm while the detector stays, so far from it."""
    inverse = torch.linalg.inv(matrix[:, :3])
    source = -inverse @ matrix[:, 3] + shift
    inverse[:, 2] -= shift / distance
    rotated = torch.linalg.inv(inverse)
    return torch.cat([rotated, -(rotated @ source)[:, None]], dim=1)


def register_case(
    case: SimulatedCase,
    draw: Draw,
    known: bool,
    options: dict[str, Any],
    images: str = "own",
    geometry: str = "right",
) -> dict[str, Any]:
    """The row of one case: errors in mm and what the registration says of itself."""
    config = RegistrationConfig(material=case.implant_material, **options)
    data, cloud, screws = registration_inputs(case, config.pitch_mm)
    if images != "own":
        data = replace(data, **unrelated_images(case, draw, data, images))
    nodes = cloud.coarsened(8).points.double()
    truth = case.deform(nodes)
    if geometry != "right":
        data = replace(data, geometry=wrong_geometry(data.geometry, truth, geometry, draw.seed))
    start = time.perf_counter()
    scene = build_scene(
        cloud,
        config,
        spectrum=case.spectrum if known else None,
        components=screws if known else (),
        holes=find_holes(case.implant),
    )
    trace = _ErrorsOfStages(truth)
    result = Trainer(scene, data, config, callbacks=[trace]).fit()
    found = result.warp(nodes)
    errors = found - truth
    ray = case.geometry.source_positions.double().mean(0) - nodes.mean(0)
    depth = errors @ (ray / ray.norm())
    beads = float(bb_rmse(result.warp(case.beads_before.double()), case.beads_after.double()))
    node, largest = float(bb_rmse(errors, torch.zeros_like(errors))), float(errors.norm(dim=-1).max()) / 3
    return {
        "seed": draw.seed,
        "beads": round(beads, 4),
        "nodes": round(node, 4),
        "shape": round(float(bb_rmse(transform_points(fit_rigid(found, truth), found), truth)), 4),
        "largest_third": round(largest, 4),
        "worst": round(max(beads, node, largest), 4),
        "depth": round(float(depth.square().mean().sqrt()), 4),
        "gc": round(float(result.gc.mean()), 4),
        **{name: value for name, value in result.diagnostics.items() if name != "gc"},
        "gc_views": result.diagnostics["gc"],
        "status": result.status,
        "warnings": "; ".join(result.warnings),
        "seconds": round(time.perf_counter() - start, 1),
        "azimuth": draw.azimuth_deg,
        "scatter": round(draw.detector.scatter_fraction + draw.detector.scatter_removed, 3),
        "kind": f"{draw.material} {draw.screw_material} {draw.scanner} {draw.kvp} kV water {draw.water_radius:.0f}",
        "physics": " ".join(f"{name}={value:.3f}" for name, value in result.intensity.items()),
        "stages": " ".join(trace.errors),
        "coverage": coverage_of(result.implants[0], case, nodes, errors),
        **load_errors(case, result.deformation),
    }


def coverage_of(
    implant: RegisteredImplant, case: SimulatedCase, nodes: torch.Tensor, errors: torch.Tensor
) -> dict[str, list[float]]:
    """Which share of true positions lies within so many stated deviations, for each of `WIDTHS`."""
    known = implant.deviations
    if known is None:
        return {}
    beads = case.beads_before.double()
    off = {"nodes": (nodes, errors), "beads": (beads, implant.warp(beads) - case.beads_after.double())}
    _, axes = torch.linalg.eigh(torch.outer(known.depth, known.depth))
    first, second = axes[:, 0], axes[:, 1]
    found = {}
    for name, (points, error) in off.items():
        spread = known.covariance(points)
        for part, directions in (("lateral", (first, second)), ("depth", (known.depth,))):
            sizes = [(error @ d).abs() / torch.einsum("i,nij,j->n", d, spread, d).sqrt() for d in directions]
            size = torch.cat(sizes)
            found[f"{name} {part}"] = [round(float((size <= width).double().mean()), 4) for width in WIDTHS]
    return found


def coverage_summary(rows: list[dict[str, Any]], path: Path) -> str:
    """Shares within one and two deviations, averaged over cases; draws them for all widths."""
    curves = {name: np.mean([row["coverage"][name] for row in rows], axis=0) for name in rows[0]["coverage"]}
    figure, axis = plt.subplots(figsize=(5.2, 4.0), layout="constrained")
    normal = [math.erf(width / math.sqrt(2)) for width in WIDTHS]
    axis.plot(WIDTHS, normal, color="0.6", linestyle="--", label="normal distribution")
    for (name, curve), colour in zip(curves.items(), ("#0072B2", "#56B4E9", "#D55E00", "#E69F00"), strict=True):
        axis.plot(WIDTHS, curve, color=colour, label=name)
    axis.set(xlabel="half width of the interval (stated standard deviations)", ylabel="share of true positions in it")
    axis.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    told = (f"{name} {c[WIDTHS.index(1.0)]:.0%} / {c[WIDTHS.index(1.96)]:.0%}" for name, c in curves.items())
    return f"within 68 % / 95 % intervals, {len(rows)} cases: {', '.join(told)}"


def load_errors(case: SimulatedCase, deformation: Deformation) -> dict[str, Any]:
    """Bending moments in N mm: the true one, what was found, its deviation.

    In the middle between the fragments and where it is largest, each in the direction in which the plate is bent more.
    """
    carried = case.carried
    if carried is None or not isinstance(deformation, FiniteElementDeformation):
        return {}
    found = CarriedLoad.of(
        deformation.superelement, deformation.amounts.detach(), deformation.covariance, deformation.expected
    )
    signs = (found.axes @ carried.axes.mT).diagonal().sign()[:2]  # a lattice's axes may point the other way
    true, moments, std = carried.section_loads[:, 3:5], signs * found.section_loads[:, 3:5], found.section_std[:, 3:5]
    size = carried.hold_loads.abs().amax(0)
    used = carried.hold_heights[(carried.hold_loads.abs() > 1e-3 * size).any(1)]
    middle = carried.heights[-1] / 2
    gap = (used[used < middle].max() + used[used > middle].min()) / 2
    places = {"gap": int((carried.heights - gap).abs().argmin()), "largest": int(true.abs().amax(1).argmax())}
    rows = {}
    for name, at in places.items():
        axis = int(true[at].abs().argmax())
        values = (float(x[at, axis]) for x in (true, moments, std))
        rows |= {f"{name}_{key}": round(value) for key, value in zip(_MOMENTS, values, strict=True)}
    return rows


def load_summary(rows: list[dict[str, Any]], place: str) -> str:
    """How well bending moments are found at a place, and how often their intervals hold them."""
    true, found, std = (np.array([row[f"{place}_{name}"] for row in rows], dtype=float) for name in _MOMENTS)
    error = np.abs(found - true)
    within = error <= np.maximum(0.05 * np.abs(true), 50.0)
    return (
        f"bending moments, {place}, of {len(rows)}: error median {np.median(error):.0f} N mm, "
        f"{np.median(error / np.abs(true)):.1%} of them; "
        f"{within.sum()} within 5 % or 50 N mm; {np.mean(error <= std):.0%} within one standard deviation, "
        f"{np.mean(error <= 2 * std):.0%} within two"
    )


def _job(job: Job) -> dict[str, Any]:
    seed, views, elastic, known, options, images, geometry, cache = job
    torch.set_num_threads(1)
    draw = draw_case(seed)
    kept = Path(cache) / f"{'elastic-' if elastic else ''}{views}-{seed}.npy" if cache else None
    case = random_case(draw, views=views, elastic=elastic, counts=_load(kept))
    if kept is not None and not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.save(kept, case.intensity.numpy())
    try:
        row = register_case(case, draw, known, options, images, geometry)
        return row if images == "own" else {**row, "worst": float("inf")}
    except (ValueError, RuntimeError) as error:
        return {"seed": seed, "status": "failed", "warnings": f"{type(error).__name__}: {error}", "worst": float("inf")}


def _load(path: Path | None) -> torch.Tensor | None:
    return torch.from_numpy(np.load(path)) if path is not None and path.exists() else None


def rows_of(path: Path, jobs: list[Job]) -> Iterator[dict[str, Any]]:
    """Rows of all jobs, those that the table has already first; new ones are appended to it."""
    done = _read(path)
    yield from done.values()
    left = [job for job in jobs if job[0] not in done]
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=4) as pool:
        for row in tqdm(pool.imap_unordered(_job, left), total=len(left), desc="cases"):
            with path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            tqdm.write(" ".join(str(row.get(k, "")) for k in ("seed", "worst", "nodes", "gc", "status", "stages")))
            yield row


def _read(path: Path) -> dict[int, dict[str, Any]]:
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["seed"]: row for row in map(json.loads, lines)}


def summary(rows: list[dict[str, Any]]) -> str:
    """The figures that matter, in one line."""
    worst = np.array([row["worst"] for row in rows])
    nodes = np.array([row.get("nodes", np.inf) for row in rows])
    said = np.array([row["status"] != "ok" or bool(row["warnings"]) for row in rows])
    silent = [row["seed"] for row, s in zip(rows, said, strict=True) if not s and row["worst"] > WRONG_MM]
    idle = [row["seed"] for row, s in zip(rows, said, strict=True) if s and row["worst"] < RIGHT_MM]
    right = int((worst < RIGHT_MM).sum())
    seconds = np.median([row.get("seconds", np.nan) for row in rows])
    return (
        f"{len(rows)} cases: node RMSE median {np.median(nodes):.3f}, worst figure median {np.median(worst):.3f}, "
        f"90th percentile {np.percentile(worst, 90):.3f} mm; {right} below {RIGHT_MM} mm; "
        f"silent failures {len(silent)} {silent}; idle alarms {len(idle)} {idle}; {seconds:.0f} s"
    )


def draw_plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors against azimuth, scatter and gradient correlation; what the verdict doubts is hollow."""
    rows = [row for row in rows if np.isfinite(row["worst"])]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), sharey=True, layout="constrained")
    names = {"azimuth": "gantry angle (degrees; 90: face on)", "scatter": "scatter", "gc": "gradient correlation"}
    for axis, (name, label) in zip(axes, names.items(), strict=True):
        for status, face in (("ok", "#0072B2"), ("doubtful", "none"), ("failed", "none")):
            shown = [row for row in rows if row["status"] == status]
            edge = {"ok": "#0072B2", "doubtful": "#E69F00", "failed": "#D55E00"}[status]
            x, y = [row[name] for row in shown], [row["worst"] for row in shown]
            axis.scatter(x, y, s=28, facecolors=face, edgecolors=edge, label=status)
        axis.axhline(RIGHT_MM, color="0.8", zorder=0)
        axis.set(xlabel=label, yscale="log")
    axes[0].set_ylabel("largest of bead RMSE,\nnode RMSE, node maximum / 3 (mm)")
    axes[2].legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_verdict(rows: list[dict[str, Any]], path: Path) -> None:
    """Missed failures against idle alarms for every threshold of the expected error of the nodes, taken alone."""
    rows = [row for row in rows if np.isfinite(row["worst"])]
    expected = np.array([row["node_std_mm"] for row in rows])
    worst = np.array([row["worst"] for row in rows])
    wrong, right = worst > WRONG_MM, worst < RIGHT_MM
    thresholds = np.linspace(0.01, 0.2, 191)
    missed = [float((wrong & (expected <= t)).sum()) for t in thresholds]
    idle = [float((right & (expected > t)).sum()) for t in thresholds]
    figure, (left, curve) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    left.scatter(expected, worst, s=24, color="#0072B2")
    left.axhline(WRONG_MM, color="0.8", zorder=0)
    left.set(xlabel="node_std_mm", ylabel="largest error figure (mm)", xscale="log", yscale="log")
    left.xaxis.set_minor_formatter(NullFormatter())
    left.set_xticks([0.02, 0.05, 0.1, 0.2], ["0.02", "0.05", "0.1", "0.2"])
    curve.step(thresholds, missed, where="post", color="#D55E00", label=f"missed, of {wrong.sum()} above {WRONG_MM} mm")
    curve.step(thresholds, idle, where="post", color="#0072B2", label=f"idle, of {right.sum()} below {RIGHT_MM} mm")
    curve.set(xlabel="threshold of node_std_mm (mm)", ylabel="registrations")
    curve.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Writes table, summary and plots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=lambda text: [int(s) for s in text.split(",")], help="these seeds alone")
    parser.add_argument("--views", choices=("neighbours", "around", "both", "spread"), default="neighbours")
    parser.add_argument("--elastic", action="store_true", help="plates bend under loads that are known")
    parser.add_argument("--known", action="store_true", help="screws and spectrum are told")
    parser.add_argument(
        "--images", choices=("own", "other", "mirrored", "turned"), default="own", help="else: wrong ones"
    )
    parser.add_argument("--geometry", choices=("right", *ERRORS, "all"), default="right", help="else: one that is off")
    parser.add_argument("--options", type=json.loads, default={}, help="options of the registration as JSON")
    parser.add_argument("--cache", default="", help="folder that keeps the images")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    name = f"population-{options.views}-{'known' if options.known else 'plain'}"
    name += "-elastic" if options.elastic else ""
    name += "" if options.images == "own" else f"-{options.images}"
    name += "" if options.geometry == "right" else f"-{options.geometry}"
    seeds = options.seeds or range(options.first, options.first + options.cases)
    same = (
        options.views,
        options.elastic,
        options.known,
        options.options,
        options.images,
        options.geometry,
        options.cache,
    )
    jobs = [(seed, *same) for seed in seeds]
    rows = sorted(rows_of(options.out / f"{name}.jsonl", jobs), key=lambda row: row["seed"])
    with (options.out / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, max(rows, key=len), extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    if options.images == "own":
        draw_plot(rows, options.out / f"{name}.png")
        draw_verdict([row for row in rows if "node_std_mm" in row], options.out / f"{name}-verdict.png")
    print(summary(rows))
    if covered := [row for row in rows if row.get("coverage")]:
        print(coverage_summary(covered, options.out / f"{name}-coverage.png"))
    if loads := [row for row in rows if "gap_true" in row]:
        print(*(load_summary(loads, place) for place in ("gap", "largest")), sep="\n")


if __name__ == "__main__":
    main()

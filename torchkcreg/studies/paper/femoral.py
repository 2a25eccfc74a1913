"""Experiment B: a bent femoral plate in water with calcium rods, registered and reconstructed (Fig. 4 and 5)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchkcreg.commands.evaluate import evaluate_files
from torchkcreg.commands.reconstruct_inputs import registered_components
from torchkcreg.console import markdown_table
from torchkcreg.evaluation import ShapeEvaluation, bb_rmse, cylinder_region, distance_to, region_statistics
from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_json, read_volume, write_figure, write_json, write_text
from torchkcreg.physics import material
from torchkcreg.simulation.bench import Recipe
from torchkcreg.visualization import reconstruction_figure

from .departures import PAPER, Settings, departures
from .experiment import ViewSets, packaged, reconstructed, registered, seconds_of, simulated, start_of

CONFIGURATION = "deformed"
_METHODS = {"FDK": "fdk", "PWLS": "pwls", "KC-Rec": "kcrec"}
_QUICK_RECONSTRUCTION = {"spacing_mm": 1.6, "iterations": 10, "passes": 1}
_INSIDE = 0.75  # share of a rod's radius that is measured
_WITHIN_MM = 40.0  # distance from the isocentre along z that is measured
_NEAR_MM = 5.0  # distance from the metal that streaks and blooming reach


def femoral_plate(out: Path, *, quick: bool = False, known: bool = True, paper: bool = False) -> str:
    """Run the experiment, write all results and figures to a folder, and return its tables.

    A titanium plate was bent before it was put into a water bath. It is registered from three and from twelve views and
    compared with its true shape: distances to the surface and to the nearest node, after rigid alignment by coherent
    point drift. Its scan is then reconstructed by FDK, by PWLS and by KC-Rec with the registered plate. Existing
    results are kept.

    Args:
        out: Output folder, created if missing.
        quick: Three binned views and a scan of 50 views on coarse voxels: takes a few minutes.
        known: Give screws and spectrum to the registration.
        paper: Also register three views with the paper's settings; takes minutes.

    Raises:
        FileExistsError: If the folder holds another experiment.
    """
    out, content, sets = Path(out), packaged("femoral_plate"), ViewSets.of_paper(quick=quick)
    imaged = {"views": sets.imaged, "binning": 2 if quick else 1, "cols": 384}
    case = simulated(content, out / "views", scanner=imaged)
    start, metal = start_of(out), content["implant"]["material"]
    jobs = [(number, False) for number in sorted(sets.views)] + ([(3, True)] if paper else [])
    rows = []
    for number, paper_settings in jobs:
        run = out / "runs" / f"{CONFIGURATION}-{number}{'-paper' if paper_settings else ''}"
        default = Settings({"material": metal}, screws=known, spectrum=known)
        result = registered(
            case,
            CONFIGURATION,
            sets.places(number),
            run,
            start=start,
            settings=departures(metal)[PAPER] if paper_settings else default,
        )
        figures = out / f"evaluation-{run.name}"
        shape = evaluate_files(run, reference=case / f"{CONFIGURATION}_implant.stl", figures=figures).shape
        assert shape is not None  # a reference was given
        truth = read_json(case / "truth.json", "truth")["cfg"][0]
        before, after = (torch.tensor(truth[f"nodes_{state}_mm"]).double() for state in ("undeformed", "deformed"))
        nodes = float(bb_rmse(result.warp(before), after))
        rows.append(_row(number, paper_settings, shape, nodes, result.status, seconds_of(run)))
        write_json(out / f"{run.name}.json", {**shape.to_dict(), "nodes_rmse_mm": nodes})
        print(
            f"{number} views{', paper' if paper_settings else ''}: nodes off by {nodes:.3f} mm; {result.status}",
            flush=True,
        )
    header = [
        "views",
        "settings",
        "nodes",
        "to surface: mean",
        "RMSE",
        "to nearest node: RMSE",
        "its floor",
        "",
        "seconds",
    ]
    table = markdown_table(header, rows) + "\n\n" + _reconstructions(content, out, quick)
    write_text(out / "table.md", table + "\n")
    return table


def _row(
    number: int, paper_settings: bool, shape: ShapeEvaluation, nodes: float, status: str, seconds: float
) -> list[str]:
    surface, near, floor = shape.surface_after, shape.nodes_after, shape.node_floor
    return [
        str(number),
        "the paper's" if paper_settings else "default",
        f"{nodes:.3f}",
        "-" if surface is None else f"{surface.mean_mm:.3f}",
        "-" if surface is None else f"{surface.rmse_mm:.3f}",
        "-" if near is None else f"{near.rmse_mm:.3f}",
        "-" if floor is None else f"{floor[1]:.3f}",
        status,
        f"{seconds:.0f}",
    ]


def _reconstructions(content: Mapping[str, Any], out: Path, quick: bool) -> str:
    """Reconstruct the scan by each method, draw `slices.png` and return the table of regions."""
    views = {"num_views": 50, "step": "4 deg", "phase": "92 deg", "binning": 4} if quick else {"binning": 2}
    scan = simulated(content, out / "scan", scanner={**views, "cols": 384})
    run, changes = out / "runs" / f"{CONFIGURATION}-3", _QUICK_RECONSTRUCTION if quick else {}
    volumes, numbers = {}, {}
    grid: VolumeGrid | None = None
    for name, method in _METHODS.items():
        options = {key: value for key, value in changes.items() if method != "fdk" or key == "spacing_mm"}
        folder = out / "reconstructions" / method
        path = reconstructed(scan, CONFIGURATION, folder, run=run, method=method, scatter="run", **options)
        volumes[name], grid = read_volume(path)
        numbers[name] = read_json(folder / "metrics.json", "metrics")
        print(f"{name}: {numbers[name]['seconds']:.0f} s", flush=True)
    assert grid is not None  # at least one method ran
    components = registered_components(run)
    metal = sum((component.fraction(grid) for component in components), torch.zeros(grid.shape))
    window = (0.0, 2 * float(numbers["FDK"]["water"]))
    figure = reconstruction_figure(volumes, grid, heights_mm=(-25.0, 0.0, 25.0), window=window, metal=metal)
    write_figure(out / "slices.png", figure)
    return _regions(content, volumes, numbers, grid, distance_to(metal > 0.05, grid))


def _regions(
    content: Mapping[str, Any],
    volumes: Mapping[str, torch.Tensor],
    numbers: Mapping[str, Mapping[str, Any]],
    grid: VolumeGrid,
    from_metal: torch.Tensor,
) -> str:
    """Table of errors of the mean, and standard deviations, of water and rods in HU; the truth is each material's."""
    limb, height = Recipe.of(content).limb, grid.points(dtype=torch.float64)[..., 2].abs() <= _WITHIN_MM
    assert limb.tissue is not None and limb.tissue.axis is not None and limb.tissue.radius is not None  # its recipe
    clear, near = from_metal > 2 * max(grid.spacing), from_metal <= max(_NEAR_MM, 3 * max(grid.spacing))
    x, y, z = limb.tissue.axis
    bath = cylinder_region(grid, (x, y, z - 60.0), (x, y, z + 60.0), 0.9 * limb.tissue.radius)
    regions: dict[str, tuple[torch.Tensor, str]] = {}
    for rod in limb.inserts:
        region = cylinder_region(grid, rod.start, rod.end, _INSIDE * rod.radius)
        regions[f"{rod.calcium_mg_ml:g} mg/mL"] = (region & height & clear, rod.substance)
        bath &= ~cylinder_region(grid, rod.start, rod.end, 1.3 * rod.radius)
    regions = {
        "water": (bath & height & clear, "water"),
        "water near the metal": (bath & clear & near & height, "water"),
    } | regions
    rows = []
    for name, (region, substance) in regions.items():
        cells = []
        for method, volume in volumes.items():
            water, energy = float(numbers[method]["water"]), numbers[method]["reference_kev"]
            statistics = region_statistics(volume, region)
            expected = float(material(substance).attenuation((float(energy or _energy(water)),))[0])
            cells.append(f"{1000 * (statistics.mean - expected) / water:+.0f} ± {1000 * statistics.std / water:.0f}")
        rows.append([name, *cells])
    return markdown_table(["error of the mean, deviation (HU)", *volumes], rows)


def _energy(water: float) -> float:
    """Energy in keV at which water has the attenuation `water`."""
    energies = torch.arange(20.0, 120.0, 0.25, dtype=torch.float64, device="cpu")
    return float(energies[(material("water").attenuation(energies) - water).abs().argmin()])

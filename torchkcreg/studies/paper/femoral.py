"""Experiment B: a bent femoral plate in water with rods of calcium, and its scan without and with it (Fig. 4 and 5)."""

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

from .experiment import PAPER_SETTINGS, ViewSets, packaged, reconstructed, registered, seconds_of, simulated, start_of

CONFIGURATION = "deformed"
_METHODS = {"FDK": "fdk", "PWLS": "pwls", "KC-Rec": "kcrec"}
_QUICK_RECONSTRUCTION = {"spacing_mm": 1.6, "iterations": 10, "passes": 1}
_INSIDE = 0.75  # of a rod's radius, where it is measured
_WITHIN_MM = 40.0  # of the isocentre along z
_NEAR_MM = 5.0  # of the metal: what streaks and blooming reach


def femoral_plate(out: Path, *, quick: bool = False, known: bool = True, paper: bool = False) -> str:
    """The experiment's tables; they, the figures and all that they are made of are left in a folder.

    A titanium plate that was bent before it was put into a bath of water is registered from three views and from
    twelve, and compared with its true shape: distances to the surface and to the nearest node, after rigid alignment by
    coherent point drift. Its scan is then reconstructed by FDK, by PWLS and by KC-Rec with the registered plate. What
    is there already is kept.

    Args:
        out: Folder to make.
        quick: Three views, binned, and a scan of 50 views on coarse voxels: a few minutes.
        known: Screws and spectrum are told.
        paper: Register three views with the paper's own settings, too. Minutes.

    Raises:
        FileExistsError: If the folder holds another experiment.
    """
    out, content, sets = Path(out), packaged("femoral_plate"), ViewSets.of_paper(quick=quick)
    imaged = {"views": sets.imaged, "binning": 2 if quick else 1, "cols": 384}
    case = simulated(content, out / "views", scanner=imaged)
    start, options = start_of(out), {"material": content["implant"]["material"]}
    jobs = [(number, False) for number in sorted(sets.views)] + ([(3, True)] if paper else [])
    rows = []
    for number, own in jobs:
        run = out / "runs" / f"{CONFIGURATION}-{number}{'-paper' if own else ''}"
        chosen = PAPER_SETTINGS if own else options
        result = registered(
            case, CONFIGURATION, sets.places(number), run, start=start, options=chosen, known=known and not own
        )
        figures = out / f"evaluation-{run.name}"
        shape = evaluate_files(run, reference=case / f"{CONFIGURATION}_implant.stl", figures=figures).shape
        assert shape is not None  # there is a reference
        truth = read_json(case / "truth.json", "truth")["cfg"][0]
        before, after = (torch.tensor(truth[f"nodes_{state}_mm"]).double() for state in ("undeformed", "deformed"))
        nodes = float(bb_rmse(result.warp(before), after))
        rows.append(_row(number, own, shape, nodes, result.status, seconds_of(run)))
        write_json(out / f"{run.name}.json", {**shape.to_dict(), "nodes_rmse_mm": nodes})
        print(f"{number} views{', paper' if own else ''}: nodes off by {nodes:.3f} mm; {result.status}", flush=True)
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


def _row(number: int, own: bool, shape: ShapeEvaluation, nodes: float, status: str, seconds: float) -> list[str]:
    surface, near, floor = shape.surface_after, shape.nodes_after, shape.node_floor
    return [
        str(number),
        "the paper's" if own else "default",
        f"{nodes:.3f}",
        "-" if surface is None else f"{surface.mean_mm:.3f}",
        "-" if surface is None else f"{surface.rmse_mm:.3f}",
        "-" if near is None else f"{near.rmse_mm:.3f}",
        "-" if floor is None else f"{floor[1]:.3f}",
        status,
        f"{seconds:.0f}",
    ]


def _reconstructions(content: Mapping[str, Any], out: Path, quick: bool) -> str:
    """A table of regions, and ``slices.png`` beside it."""
    views = {"num_views": 50, "step": "4 deg", "phase": "92 deg", "binning": 4} if quick else {"binning": 2}
    scan = simulated(content, out / "scan", scanner={**views, "cols": 384})
    run, more = out / "runs" / f"{CONFIGURATION}-3", _QUICK_RECONSTRUCTION if quick else {}
    volumes, numbers = {}, {}
    grid: VolumeGrid | None = None
    for name, method in _METHODS.items():
        own = {key: value for key, value in more.items() if method != "fdk" or key == "spacing_mm"}
        folder = out / "reconstructions" / method
        path = reconstructed(scan, CONFIGURATION, folder, run=run, method=method, scatter="run", **own)
        volumes[name], grid = read_volume(path)
        numbers[name] = read_json(folder / "metrics.json", "metrics")
        print(f"{name}: {numbers[name]['seconds']:.0f} s", flush=True)
    assert grid is not None  # there are methods
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
    """Means and deviations of water and rods, HU against water, each against what its material has."""
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
    for name, (region, of) in regions.items():
        found = []
        for method, volume in volumes.items():
            water, energy = float(numbers[method]["water"]), numbers[method]["reference_kev"]
            there = region_statistics(volume, region)
            asked = float(material(of).attenuation((float(energy or _energy(water)),))[0])
            found.append(f"{1000 * (there.mean - asked) / water:+.0f} ± {1000 * there.std / water:.0f}")
        rows.append([name, *found])
    return markdown_table(["error of the mean, deviation (HU)", *volumes], rows)


def _energy(water: float) -> float:
    """The energy at which water attenuates so, keV."""
    energies = torch.arange(20.0, 120.0, 0.25, dtype=torch.float64, device="cpu")
    return float(energies[(material("water").attenuation(energies) - water).abs().argmin()])

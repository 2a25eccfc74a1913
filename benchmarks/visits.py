"""Whole simulated visits, assessed with nothing known but mesh, alloy, geometry and scans, against their truth.

    python benchmarks/visits.py --work /tmp/visits [--cases 8] [--first 0] [--known] [--write]

Each visit is a plate of the population (`torchkcreg.simulation.draw_case`) on two rigid fragments, scanned without load
and under a force on the upper fragment, in 24 views around, the limb placed anew in between. The mesh is turned and
shifted into a random CAD frame. Visits that were assessed before in the work folder are not assessed again.
"""

import argparse
import csv
import json
import math
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchkcreg.commands import VisitFiles, assess
from torchkcreg.geometry import fit_rigid, invert_rigid, rigid_matrix, transform_points, vector_from_rotation
from torchkcreg.io import (
    read_json,
    read_run,
    write_components,
    write_geometry,
    write_json,
    write_mesh,
    write_projections,
    write_spectrum,
)
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.simulation import SimulatedCase, draw_case, random_case
from torchkcreg.simulation.bench.loaded import loaded
from torchkcreg.simulation.bench.quantities import quantity
from torchkcreg.simulation.bench.recipe import LoadRecipe
from torchkcreg.simulation.bench.specimen import DISTAL, PROXIMAL
from torchkcreg.simulation.population import ElasticConstruct, random_specimen

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    """Simulate and assess the visits and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--known", action="store_true", help="screws and spectrum are known")
    parser.add_argument("--write", action="store_true", help="write the table to benchmarks/results")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for seed in range(options.first, options.first + options.cases):
        folder = options.work / f"visit{seed:03d}"
        if not (folder / "truth.json").exists():
            simulate(seed, folder)
        rows.append(measured(folder, options.known))
        print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    if options.write:
        name = f"visits{'-known' if options.known else ''}.csv"
        with (RESULTS / name).open("w", newline="") as file:
            names = [name for name in max(rows, key=len) if name != "seconds"]
            table = csv.DictWriter(file, names, lineterminator="\n", extrasaction="ignore")
            table.writeheader()
            table.writerows(rows)


def simulate(seed: int, folder: Path) -> None:
    """Write the files of a visit and its truth."""
    folder.mkdir(parents=True, exist_ok=True)
    draw = replace(draw_case(seed), loose=None)
    case = random_case(draw, views="many", elastic=True)
    rng = np.random.default_rng([seed, 43])
    turned, shifted = rng.uniform(-2.5, 2.5, 3).tolist(), rng.uniform(-4, 4, 3).tolist()
    still = LoadRecipe.of({"rotation": quantity(turned, "deg"), "translation": quantity(shifted, "mm")})
    specimen = random_specimen(draw)
    recipe = specimen.recipe.model_copy(update={"configurations": {"rest": still}, "seed": seed + 7919})
    rest = SimulatedCase.of(replace(specimen, recipe=recipe), case.geometry, tungsten_spectrum(draw.kvp))
    turn = torch.from_numpy(rng.normal(size=3))
    frame = rigid_matrix(turn / turn.norm() * rng.uniform(0.5, 3.1), torch.from_numpy(rng.uniform(-80, 80, 3)))
    write_mesh(folder / "implant.stl", case.implant.copy().apply_transform(frame.numpy()))
    write_geometry(folder / "geometry.json", case.geometry)
    write_components(folder / "screws.json", [screw.moved_by(frame) for screw in case.screws])
    write_spectrum(folder / "spectrum.csv", tungsten_spectrum(draw.kvp))
    for name, each in (("rest", rest), ("stand", case)):
        write_projections(folder / f"{name}.npz", intensity=each.intensity, open_beam=each.open_beam)
    fragments = loaded(specimen, case.load, ElasticConstruct(specimen)).fragments
    carried = case.carried
    assert carried is not None
    corners = torch.from_numpy(np.array(case.implant.vertices))
    truth = {
        "material": draw.material,
        "force_n": float(torch.tensor(case.load.force).norm()),
        "pose": fit_rigid(corners, rest.deform(corners)),  # of the unloaded implant in the world
        "motion": invert_rigid(fragments[DISTAL]) @ fragments[PROXIMAL],  # with the lower fragment at rest
        "axis": carried.axes[2],
        "low": float((torch.from_numpy(np.array(case.implant.vertices)) @ carried.axes[2]).min()),
        "heights": carried.heights,
        "section_loads": carried.section_loads,
    }
    write_json(folder / "truth.json", {k: v.tolist() if isinstance(v, torch.Tensor) else v for k, v in truth.items()})


def measured(folder: Path, known: bool) -> dict[str, object]:
    """Assess a visit, or read its assessment, and compare it with the truth."""
    truth, out = read_json(folder / "truth.json", "truth"), folder / ("known" if known else "plain")
    seconds = float("nan")
    if not (out / "assess.json").exists():
        files = VisitFiles(
            implant=folder / "implant.stl",
            material=truth["material"],
            geometry=folder / "geometry.json",
            unloaded=folder / "rest.npz",
            loaded=[folder / "stand.npz"],
            screws=folder / "screws.json" if known else None,
            spectrum=folder / "spectrum.csv" if known else None,
        )
        start = time.perf_counter()
        try:
            assess(files, out, overwrite=True, volumes=False, figures=False)
        except ValueError as error:
            return {"visit": folder.name, "verdict": "refused", "why": str(error)[:150]}
        seconds = time.perf_counter() - start
    answer = json.loads((out / "assess.json").read_text())["configurations"][0]
    if "rotation_deg" not in answer:
        return {"visit": folder.name, "verdict": answer["status"], "why": answer["reasons"][0][:150]}
    numbers = {name: torch.tensor(truth[name], dtype=torch.float64) for name in ("pose", "motion", "axis")}
    motion, unloaded = numbers["motion"], read_run(out / "rest").implants[0]

    def place_of(name: str) -> torch.Tensor:
        """A place in the true implant's frame, by way of the world: a symmetric plate may be found turned around."""
        at = torch.tensor([answer["places"][name]["at_mm"]], dtype=torch.float64)
        return transform_points(invert_rigid(numbers["pose"]), unloaded.warp(at))

    row: dict[str, object] = {"visit": folder.name.removeprefix("visit"), "verdict": answer["status"]}
    row["plate"] = f"{truth['material']}, {truth['force_n']:.0f} N"
    angle = float(vector_from_rotation(motion[:3, :3]).norm().rad2deg())
    row["tilt (degrees)"] = _told(angle, answer["rotation_deg"], answer["rotation_std_deg"], 2)
    for name, where in (("gap", "implant"), ("bone axis", "bone axis")):
        if name in answer["places"]:
            place, told = place_of(name), answer["places"][name]
            moved = float((transform_points(motion, place) - place).norm())
            key = f"translation at the {where} (mm)"
            row[key] = _told(moved, told["translation_mm"], told["translation_std_mm"], 3)
    height = float(place_of("gap")[0] @ numbers["axis"]) - truth["low"]
    sections = np.array(truth["section_loads"])
    moment = np.array([np.interp(height, truth["heights"], sections[:, k]) for k in (3, 4, 5)])
    found, std = (answer[name] / 1000 for name in ("moment_nmm", "moment_std_nmm"))
    row["moment (N m)"] = _told(float(np.linalg.norm(moment)) / 1000, found, std, 1)
    return row if math.isnan(seconds) else row | {"seconds": f"{seconds:.0f}"}


def _told(true: float, found: float, std: float, digits: int) -> str:
    """A found value, its stated standard deviation and the true value."""
    return f"{found:.{digits}f} ± {std:.{digits}f} ({true:.{digits}f})"


if __name__ == "__main__":
    main()

"""The demo: simulate a plate under load, register it like a patient's, and compare with the truth."""

from __future__ import annotations

import time
from pathlib import Path

import torch
from torch import Tensor

from torchkcreg.evaluation import PointMetrics, evaluate_points, point_errors
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import (
    REPORT,
    write_components,
    write_geometry,
    write_json,
    write_mesh,
    write_points,
    write_projections,
    write_spectrum,
)
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.registration import RegistrationResult
from torchkcreg.simulation import SimulatedCase, weight_bearing_case

from .register import register_files
from .register_inputs import RegistrationFiles

CASE, RUN, EVALUATION = "case", "run", "evaluation.json"
SIMULATED_KVP, ASSUMED_KVP = 100, 90
VIEWS = (47, 48, 49)


def demo(out: Path, *, seed: int = 0, overwrite: bool = False) -> dict[str, PointMetrics]:
    """Run the demo and return its errors at the beads and the plate's nodes, at the start pose and after registration.

    A plate with screws, bone and beads is bent by about 5 mm at its end, imaged in three neighbouring views with a
    polyenergetic beam, scatter, blur and noise, and registered. The registration does not use the spectrum, scatter,
    blur, bone or projector of the simulation: it gets the screws and a spectrum of a lower tube voltage. The registered
    plate is then compared with the true one. The simulated case and the run stay in `out`.

    Args:
        out: Output folder, with `case/`, `run/` and `evaluation.json`.
        seed: Seed of the load's direction, the noise and the optimiser.
        overwrite: Replace an existing demo in the folder.

    Returns:
        Errors under "beads at the start", "beads", "plate at the start" and "plate".

    Raises:
        FileExistsError: If the folder holds other files, or a demo and `overwrite` is False.
    """
    out, start = Path(out), time.perf_counter()
    _check_folder(out, overwrite)
    angles = ", ".join(map(str, VIEWS))
    print(f"Simulating a loaded ten-hole plate in three views ({angles} degrees) at {SIMULATED_KVP} kV ...", flush=True)
    case = weight_bearing_case(1.0, seed=seed, views=VIEWS, kvp=SIMULATED_KVP)
    files = _write_case(out / CASE, case)
    print(
        f"Registering it with known screws, but {ASSUMED_KVP} kV and without bone and scatter ...",
        flush=True,
    )
    overrides = {"material": case.implant_material, "seed": seed}
    result = register_files(files, out / RUN, overrides=overrides, overwrite=overwrite)
    metrics, table = _evaluate(case, result)
    write_json(out / EVALUATION, {name: m.to_dict() for name, m in metrics.items()})
    print(f"\n{table}\n")
    print(f"{time.perf_counter() - start:.0f} s. Pictures:")
    for picture in ("overlay", "displacement", "history"):
        print(f"  {out / RUN / picture}.png")
    print(f"Report with everything: {out / RUN / REPORT}")
    return metrics


def _check_folder(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"demo folder {out} cannot be made: a file is in the way")
    entries = {entry.name for entry in out.iterdir()} if out.is_dir() else set()
    if foreign := sorted(entries - {CASE, RUN, EVALUATION}):
        raise FileExistsError(f"folder {out} holds more than a demo ({foreign[0]}): choose another one")
    if entries and not overwrite:
        raise FileExistsError(f"folder {out} holds a demo already: replace it with --overwrite or choose another one")


def _write_case(folder: Path, case: SimulatedCase) -> RegistrationFiles:
    """Write the input files of a registration and the beads' positions; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh = folder / "implant.stl"
    files = RegistrationFiles(
        implant=mesh,
        geometry=folder / "geometry.json",
        projections=folder / "projections.npz",
        components=folder / "screws.json",
        spectrum=folder / "spectrum.csv",
    )
    write_mesh(mesh, case.implant)
    write_geometry(files.geometry, case.geometry)
    write_projections(files.projections, intensity=case.intensity, open_beam=case.open_beam)
    write_components(folder / "screws.json", case.screws)
    write_spectrum(folder / "spectrum.csv", tungsten_spectrum(ASSUMED_KVP))
    write_points(folder / "beads_before.csv", case.beads_before)
    write_points(folder / "beads_after.csv", case.beads_after)
    return files


def _evaluate(case: SimulatedCase, result: RegistrationResult) -> tuple[dict[str, PointMetrics], str]:
    """Errors before and after registration, and a table of them as text."""
    nodes = ImplantPointCloud.from_mesh(case.implant, pitch=1.0, dtype=torch.float64).points
    beads, true_beads, true_nodes = case.beads_before, case.beads_after, case.deform(nodes)
    metrics = {
        "beads at the start": evaluate_points(beads, true_beads),
        "beads": evaluate_points(result.warp(beads), true_beads),
        "plate at the start": evaluate_points(nodes, true_nodes),
        "plate": evaluate_points(result.warp(nodes), true_nodes),
    }
    return metrics, _table(metrics, point_errors(beads, true_beads), point_errors(result.warp(beads), true_beads))


def _table(metrics: dict[str, PointMetrics], start: Tensor, registered: Tensor) -> str:
    rows = [(f"bead {i + 1}", a, b) for i, (a, b) in enumerate(zip(start.tolist(), registered.tolist(), strict=True))]
    for name in ("beads", "plate"):
        before, after = metrics[f"{name} at the start"], metrics[name]
        rows.append((f"{name}, RMSE", before.rmse_mm, after.rmse_mm))
        rows.append((f"{name}, largest", before.max_mm, after.max_mm))
    head = f"{'error in mm':18s} {'start':>8s} {'registered':>11s}"
    return "\n".join([head, *(f"{name:18s} {a:8.3f} {b:11.3f}" for name, a, b in rows)])

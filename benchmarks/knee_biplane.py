"""Real X-rays of a knee replacement in two calibrated views, registered from nowhere, against fits to their edges.

    python benchmarks/knee_biplane.py DATA --work /tmp/knee [--frames 0 60 100 160 250] [--write]

DATA holds `images/cam{1,2}_frame{NNN}.tif` (8 bit), `Camcal{1,2}.txt` (MayaCam 2.0), `femur0_closed.stl`, `tibia0.stl`
and poses to compare with, `femur_poses_from_edges.json` and `tibia_poses.json` (frame: 4 x 4, component to world). The
X-rays are those of `example_studies/Subject0` of github.com/ajensen1234/JTML. Frames that were registered in the work
folder before are not registered again.
"""

import argparse
import csv
import json
import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import torch

from torchkcreg.commands import RegistrationFiles, register_files
from torchkcreg.geometry import transform_points, vector_from_rotation
from torchkcreg.io import read_mesh, read_run

RESULTS = Path(__file__).parent / "results" / "knee_biplane.csv"
COMPONENTS = {"femur": ("femur0_closed", "femur_poses_from_edges.json"), "tibia": ("tibia0", "tibia_poses.json")}


def main() -> None:
    """Register the frames and print a row for each component."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 60, 100, 160, 250])
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = [row for frame in options.frames for row in measured(options.data, options.work, frame)]
    if options.write:
        with RESULTS.open("w", newline="") as file:
            table = csv.DictWriter(file, rows[0], lineterminator="\n")
            table.writeheader()
            table.writerows(rows)


def measured(data: Path, work: Path, frame: int) -> list[dict[str, object]]:
    """Rows of a frame, one a component."""
    run, images, cameras = work / f"run{frame:03d}", work / f"frame{frame:03d}", work / "cameras"
    if not (run / "deformation.json").exists():
        for folder in (images, cameras):
            folder.mkdir(parents=True, exist_ok=True)
        for camera in (1, 2):
            shutil.copy(data / "images" / f"cam{camera}_frame{frame:03d}.tif", images)
            shutil.copy(data / f"Camcal{camera}.txt", cameras)
        meshes = [data / f"{stem}.stl" for stem, _ in COMPONENTS.values()]
        files = RegistrationFiles(implant=meshes, geometry=cameras, projections=images, open_beam=255.0)
        start = time.perf_counter()
        register_files(files, run, overrides={"material": "cocr", "deformation": "rigid"}, overwrite=True)
        print(f"frame {frame}: {time.perf_counter() - start:.0f} s")
    result = read_run(run)
    expected = json.loads((run / "uncertainty.json").read_text())["implants"]
    return [row(data, frame, name, result, expected) for name in COMPONENTS]


def row(data: Path, frame: int, name: str, result, expected) -> dict[str, object]:
    """How far a component's registered pose is from the one fitted to the edges."""
    stem, poses = COMPONENTS[name]
    there = torch.tensor(json.loads((data / poses).read_text())[str(frame)], dtype=torch.float64)
    here = result.implant(stem).implant_to_world
    points = torch.from_numpy(np.array(read_mesh(data / f"{stem}.stl").vertices))
    one, other = transform_points(here, points), transform_points(there, points)
    turn = vector_from_rotation(here[:3, :3] @ there[:3, :3].T).norm().rad2deg()
    found = {
        "frame": frame,
        "component": name,
        "centre_mm": f"{float((one.mean(0) - other.mean(0)).norm()):.2f}",
        "turn_deg": f"{float(turn):.2f}",
        "surface_mm": f"{float((one - other).square().sum(-1).mean().sqrt()):.2f}",
        "expected_mm": f"{expected[stem]['node_std_mm']:.2f}",
        "gc": " ".join(f"{gc:.2f}" for gc in result.gc.tolist()),
        "status": result.status,
    }
    print("  ".join(f"{key} {value}" for key, value in found.items()), flush=True)
    return found


if __name__ == "__main__":
    main()

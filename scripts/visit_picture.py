"""Make the picture of the README: a simulated visit, from the scans to the fracture's motion and a clean volume.

    python scripts/visit_picture.py FOLDER [--out docs/visit.png]

runs the commands of `COMMANDS` in FOLDER, leaving out those whose results are there already (ten minutes on two
cores), then draws FDK, KC-Rec with the registered plate, and the plate's deflection under load.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchkcreg.cli import main as torchkcreg
from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_mesh, read_run, read_volume
from torchkcreg.visualization.style import new_figure

VISIT = Path(__file__).resolve().parents[1] / "examples" / "visit.yaml"
VIEWS = ",".join(map(str, range(3, 183, 15)))
REGISTER = (
    "register --implant case/implant.stl --material steel --components case/screws.json --spectrum case/spectrum.csv"
    f" --geometry case/geometry.json --views {VIEWS}"
)
RECONSTRUCT = "reconstruct --geometry case/geometry.json --projections case/unloaded.npz --spectrum case/spectrum.csv"
VOLUME = "--spacing 0.8 --size 100 104 220 --center 0 -14 0"
COMMANDS = {
    "case": f"simulate {shlex.quote(str(VISIT))} --out case",
    "unloaded": f"{REGISTER} --projections case/unloaded.npz --out unloaded",
    "loaded": f"{REGISTER} --projections case/loaded.npz --init unloaded --out loaded",
    "compare": "compare unloaded loaded --out compare",
    "fdk": f"{RECONSTRUCT} --method fdk {VOLUME} --out fdk",
    "kcrec": f"{RECONSTRUCT} --method kcrec --run unloaded {VOLUME} --iterations 20 --out kcrec",
}
WINDOW_HU = (-800.0, 2000.0)
SLICE_X_MM = 0.0
TIMES = 6


def sagittal(folder: Path) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """The slice x = 0 of a reconstruction in HU, upright, and its extent in y and z, mm."""
    volume, grid = read_volume(folder / "volume_hu.mha")
    x, y, z = (float(c) for c in grid.origin)
    dx, dy, dz = grid.spacing
    image = volume[:, :, round((SLICE_X_MM - x) / dx)].numpy()
    return image, (y - dy / 2, y + dy * (image.shape[1] - 0.5), z - dz / 2, z + dz * (image.shape[0] - 0.5))


def draw(folder: Path) -> Figure:
    """FDK, KC-Rec with the plate over it, and how the fragments moved, drawn larger."""
    figure = new_figure(11.0, 5.0)
    fdk, kcrec, motion = figure.subplots(1, 3, width_ratios=(1, 1, 1.15))
    for axes, name in ((fdk, "fdk"), (kcrec, "kcrec")):
        image, extent = sagittal(folder / name)
        axes.imshow(image, cmap="gray", vmin=WINDOW_HU[0], vmax=WINDOW_HU[1], origin="lower", extent=extent)
        axes.set_axis_off()
    fdk.set_title("FDK: streaks around the plate", fontsize=10)
    kcrec.set_title("KC-Rec with the registered plate", fontsize=10)
    unloaded, loaded = (read_run(folder / name).implants[0] for name in ("unloaded", "loaded"))
    points = ImplantPointCloud.from_mesh(read_mesh(folder / "case" / "implant.stl"), pitch=0.5).points.double()
    before, after = unloaded.warp(points), loaded.warp(points)
    near = before[(before[:, 0] - SLICE_X_MM).abs() < 0.6]
    kcrec.scatter(near[:, 1], near[:, 2], s=2, c="tab:orange", linewidths=0)
    for axes in (fdk, kcrec):
        axes.set(xlim=(-50, 24), ylim=(-62, 62))

    lower = points[:, 2] < -10
    moved = transform_points(fit_rigid(after[lower], before[lower]), after) - before
    for place, colour in ((before, "0.75"), (before + TIMES * moved, "tab:orange")):
        motion.scatter(place[:, 1], place[:, 2], s=1, c=colour, linewidths=0, zorder=3)
    record = json.loads((folder / "compare" / "compare.json").read_text(encoding="utf-8"))["runs"][0]
    rigid = np.array(record["motion"])
    for low, high in ((-62.0, -2.0), (2.0, 62.0)):
        y, z = np.array([-30.0, -4.0, -4.0, -30.0, -30.0]), np.array([low, low, high, high, low])
        corners = np.stack([0 * y, y, z, 1 + 0 * y])
        motion.fill(y, z, facecolor="0.93", edgecolor="0.75")
        shift = TIMES * (rigid @ corners - corners) if low > 0 else 0 * corners
        motion.fill(
            (corners + shift)[1], (corners + shift)[2], facecolor=(0.12, 0.47, 0.71, 0.15), edgecolor="tab:blue"
        )
    angle, std = record["rotation_deg"][0], record["rotation_std_deg"][0]
    motion.set_title(
        f"600 N tilt the upper fragment by {angle:.2f} ± {std:.2f}°\n(drawn {TIMES} times larger)", fontsize=10
    )
    motion.set(xlim=(-44, 22), ylim=(-68, 72), aspect="equal")
    motion.set_axis_off()
    return figure


def main() -> int:
    """Run what is missing, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=VISIT.parents[1] / "docs" / "visit.png")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    out = options.out.resolve()
    os.chdir(options.folder)
    for name, command in COMMANDS.items():
        if not Path(name).exists() and (status := torchkcreg(shlex.split(command))):
            return status
    draw(Path()).savefig(out, dpi=110)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Two-level grid (small voxels near a plate) against small or large voxels everywhere: error, noise, time, memory.

    python benchmarks/two_levels.py [--out benchmarks/results]

Writes two_levels.md and two_levels.png. Each grid runs in a separate process, to measure its memory.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from pathlib import Path

import torch
import trimesh
from common import processor, write_report

from torchkcreg.evaluation import cylinder_region, distance_to, region_statistics
from torchkcreg.geometry import TwoLevelGrid, VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import material, tungsten_spectrum
from torchkcreg.reconstruction import BeamModel, PWLSConfig, reconstruct, unknown_share
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder
from torchkcreg.visualization import reconstruction_figure

ABOUT = """KC-Rec of a water bath of 46 mm with a titanium plate of 20 x 3.4 x 12 mm and calcium wires (300 mg/mL,
0.8 and 1.6 mm thick) 1.5 to 4 mm beside it; 200 views of 160 x 48 pixels of 0.5 mm, 90 kV, 60 000 quanta, two passes of
12 iterations, roughness penalty of the same strength per mm. Voxels of 0.8 mm, of 0.267 mm, and of 0.267 mm within 6 mm
of the plate with 0.8 mm elsewhere. Evaluated within 5 mm of the metal, sampled every 0.267 mm, in 1e-5/mm (water is
about 2000): the root mean square error of all voxels, and in water at least 1.2 mm from the wires the error of the mean
and the standard deviation. Contrast is the reconstructed contrast of a wire, relative to its true contrast."""
GEOMETRY = circular_geometry(
    [i * 1.8 for i in range(200)], sad=404, sdd=538, det_shape=(48, 160), pixel_spacing=(0.5, 0.5)
)
SPECTRUM = tungsten_spectrum(90)
COARSE = VolumeGrid.centered((20, 64, 64), 0.8)
FINE = VolumeGrid.centered((60, 192, 192), 0.8 / 3)
WIRES = {0.8: (-5.7, -1.9, 2.2, 6.1), 1.6: (-4.2, 3.9)}
PLACES = [(x, 3.5 if d < 1 else -4.2, d) for d, places in WIRES.items() for x in places]
GRIDS = ("0.8 mm", "0.267 mm", "both")


def plate() -> trimesh.Trimesh:
    return trimesh.creation.box((20.0, 3.4, 12.0))


def parts() -> list[Part]:
    def rod(x: float, y: float, radius: float) -> Cylinder:
        return Cylinder(torch.tensor([x, y, -40.0]), torch.tensor([x, y, 40.0]), radius)

    wires = [Part(f"wire {i}", rod(x, y, d / 2), "ca300", inside="bath") for i, (x, y, d) in enumerate(PLACES)]
    return [
        Part("bath", rod(0.0, 0.0, 23.0), "water"),
        Part("plate", plate(), "titanium", inside="bath"),
        *wires,
    ]


def solved(name: str, beta: float) -> tuple[torch.Tensor, VolumeGrid, float, float]:
    """Reconstructed volume, its grid (of a two-level grid, the fine one), seconds, and peak memory in GiB."""
    panel = FlatPanel.ideal(photons=2e4, electronic_noise=2.0)
    transmission = simulate_projections(GEOMETRY, parts(), SPECTRUM, panel=panel).float() / panel.open_beam
    metal = [KnownComponent.from_mesh(plate(), "titanium", pitch=0.2)]
    beam = BeamModel.polyenergetic([material("titanium")], SPECTRUM)
    start, grid = time.perf_counter(), {"0.8 mm": COARSE, "0.267 mm": FINE}.get(name)
    if grid is None:
        grid = TwoLevelGrid.near(1 - unknown_share(metal, COARSE), COARSE, within_mm=6.0, factor=3)
    strength = beta / 3 if grid is FINE else beta  # for the same integral of the squared gradient
    config = PWLSConfig(iterations=12, subsets=20, beta=strength)
    volume = reconstruct(transmission, GEOMETRY, grid, beam, config=config, components=metal).volume
    seconds = time.perf_counter() - start
    if isinstance(grid, TwoLevelGrid):
        volume, grid = grid.volumes(volume)[1], grid.fine
    return volume, grid, seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def row(name: str, beta: float, volume: torch.Tensor, seconds: float, memory: float) -> str:
    """Table row of a volume on the fine grid."""
    energy = (SPECTRUM.mean_energy,)
    water, calcium = (float(material(m).attenuation(energy)[0]) for m in ("water", "ca300"))
    share = KnownComponent.from_mesh(plate(), "titanium", pitch=0.2).fraction(FINE)
    near = (distance_to(share, FINE) < 5) & (share == 0)
    near &= cylinder_region(FINE, (0, 0, -5), (0, 0, 5), 22.0)
    truth, pure_water, cells = torch.full(FINE.shape, water), near.clone(), []
    for diameter in WIRES:
        wires = [at for at in PLACES if at[2] == diameter]
        inside = torch.zeros(FINE.shape, dtype=torch.bool)
        for x, y, _ in wires:
            inside |= cylinder_region(FINE, (x, y, -40), (x, y, 40), diameter / 2)
            pure_water &= ~cylinder_region(FINE, (x, y, -40), (x, y, 40), diameter / 2 + 1.2)
        truth[inside] = calcium
        cells.append(f"{(float(volume[inside & near].mean()) - water) / (calcium - water):.2f}")
    error, background = (volume - truth)[near].square().mean().sqrt(), region_statistics(volume, pure_water)
    return (
        f"| {beta:g} | {name} | {1e5 * error:.0f} | {1e5 * (background.mean - water):.0f} | {1e5 * background.std:.0f} "
        f"| {' | '.join(cells)} | {seconds:.0f} s | {memory:.2f} GiB |"
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    lines, shown = [], {}
    for beta in (10.0, 1.0):
        for name in GRIDS:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                volume, grid, seconds, memory = pool.apply(solved, (name, beta))
            volume = resampled(volume, grid, FINE)
            lines.append(row(name, beta, volume, seconds, memory))
            print(lines[-1], flush=True)
            shown[f"{name}, beta {beta:g}"] = volume
    text = "\n".join(
        [
            "# Small voxels around the metal",
            "",
            ABOUT,
            f"{processor()}.",
            "",
            "| beta | voxels | error | water: mean | deviation | contrast, 0.8 mm | contrast, 1.6 mm | time | memory |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *lines,
            "",
        ]
    )
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(options.out / "two_levels.md", text)
    figure = reconstruction_figure(shown, FINE, heights_mm=(0.0,), window=(0.01, 0.04))
    figure.savefig(options.out / "two_levels.png", dpi=120)


def resampled(volume: torch.Tensor, grid: VolumeGrid, to: VolumeGrid) -> torch.Tensor:
    """Value of the nearest voxel, 0 outside the grid."""
    points = to.points(dtype=torch.float64)
    matrix = grid.world_to_voxel
    index = (points @ matrix[:3, :3].mT + matrix[:3, 3]).round().long()
    size = torch.tensor(grid.shape[::-1])
    inside = ((index >= 0) & (index < size)).all(-1)
    i, j, k = index.clamp_min(0).minimum(size - 1).unbind(-1)
    return torch.where(inside, volume[k, j, i], 0.0)


if __name__ == "__main__":
    main()

"""Calcium near a titanium plate, measured with one and with two tube voltages in simulated scans.

    python benchmarks/dual_energy.py [--out benchmarks/results]

Writes dual_energy.md and dual_energy.png.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
import trimesh
from common import processor, write_report

from torchkcreg.evaluation import cylinder_region, distance_to, region_statistics
from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.reconstruction import Decomposition, decompose, unknown_share
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder
from torchkcreg.visualization import reconstruction_figure

ABOUT = """A bath of 68 mm with rods of 50, 100 and 200 mg/mL of calcium and a plate of 30 x 4 x 16 mm; 180 views of
96 x 40 pixels of 1.2 mm, alternating between 70 and 120 kV, 60 000 quanta. In the second scan the bath is lighter than
water, which a single voltage mistakes for a lack of calcium. "One attenuation" is KC-Rec of the same data."""
VIEWS = 180
SPECTRA = {"low": tungsten_spectrum(70), "high": tungsten_spectrum(120)}
GRID = VolumeGrid.centered((36, 64, 64), 1.2)
RODS = {"ca50": (-18.0, -8.0), "ca100": (0.0, -18.0), "ca200": (18.0, -6.0)}


def rod(x: float, y: float, radius: float) -> Cylinder:
    return Cylinder(torch.tensor([x, y, -40.0]), torch.tensor([x, y, 40.0]), radius)


def plate() -> trimesh.Trimesh:
    box = trimesh.creation.box((30.0, 4.0, 16.0))
    box.apply_translation((0.0, 4.0, 0.0))
    return box


def scan(bath: str) -> tuple[ConeBeamGeometry, torch.Tensor]:
    """Geometry of views with alternating tube voltage, and their transmission."""
    circle = circular_geometry(
        [i * 360 / VIEWS for i in range(VIEWS)], sad=404, sdd=538, det_shape=(40, 96), pixel_spacing=(1.2, 1.2)
    )
    sources = ["low" if i % 2 == 0 else "high" for i in range(VIEWS)]
    geometry = ConeBeamGeometry(circle.projection_matrices, circle.det_shape, circle.pixel_spacing, sources=sources)
    parts = [Part("bath", rod(0.0, 0.0, 34.0), bath), Part("plate", plate(), "titanium", inside="bath")]
    parts += [Part(name, rod(*place, 6.0), name, inside="bath") for name, place in RODS.items()]
    panel = FlatPanel.ideal(photons=2e4, electronic_noise=2.0)
    return geometry, simulate_projections(geometry, parts, SPECTRA, panel=panel).float() / panel.open_beam


def rows(bath: str, decomposition: Decomposition, far: torch.Tensor) -> list[str]:
    """Table rows: means and standard deviations in the rods and in the bath near the plate."""
    regions = {name: cylinder_region(GRID, (*at, -9.0), (*at, 9.0), 4.5) for name, at in RODS.items()}
    near = cylinder_region(GRID, (0, 0, -9), (0, 0, 9), 25.0) & (far > 2) & (far < 8)
    for at in RODS.values():
        near &= ~cylinder_region(GRID, (*at, -9.0), (*at, 9.0), 8.0)
    lines = []
    for name, region in {**regions, f"{bath} near the plate": near}.items():
        dual, single = (region_statistics(x, region) for x in (decomposition.calcium_mg_ml, decomposition.single_mg_ml))
        density = region_statistics(decomposition.water, region).mean
        lines.append(
            f"| {bath} | {name} | {dual.mean:.1f} | {dual.std:.1f} "
            f"| {single.mean:.1f} | {single.std:.1f} | {density:.3f} |"
        )
    return lines


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    metal = [KnownComponent.from_mesh(plate(), "titanium", pitch=0.3)]
    far = distance_to(1 - unknown_share(metal, GRID), GRID)
    lines, seconds, shown = [], 0.0, {}
    for bath in ("water", "adipose_tissue"):
        geometry, transmission = scan(bath)
        start = time.perf_counter()
        decomposition = decompose(transmission, geometry, GRID, SPECTRA, components=metal, progress=None)
        seconds = time.perf_counter() - start
        lines += rows(bath, decomposition, far)
        shown[f"{bath}: two voltages"], shown[f"{bath}: one attenuation"] = (
            decomposition.calcium_mg_ml,
            decomposition.single_mg_ml,
        )
    text = "\n".join(
        [
            "# Calcium from two tube voltages",
            "",
            ABOUT,
            f"mg/mL, means and standard deviations. {seconds:.0f} s per scan; {processor()}.",
            "",
            "| bath | region | two voltages | std | one attenuation | std | water's density |",
            "| --- | --- | --- | --- | --- | --- | --- |",
            *lines,
            "",
        ]
    )
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(options.out / "dual_energy.md", text)
    figure = reconstruction_figure(shown, GRID, heights_mm=(0.0,), window=(-150.0, 250.0), unit="mg/mL")
    figure.savefig(options.out / "dual_energy.png", dpi=120)


if __name__ == "__main__":
    main()

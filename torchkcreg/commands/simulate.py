"""Simulate an experiment from a recipe: write the input files of a registration and the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import (
    read_components,
    read_config,
    read_geometry,
    read_json,
    read_mesh,
    read_spectrum,
    write_components,
    write_config,
    write_figure,
    write_geometry,
    write_json,
    write_mesh,
    write_projections,
    write_spectrum,
)
from torchkcreg.physics import Spectrum, material, tungsten_spectrum
from torchkcreg.plain import plain
from torchkcreg.simulation.bench import (
    Acquisition,
    Recipe,
    Specimen,
    acquisitions,
    recipe_files,
    recipe_in,
    specimen,
    views_of,
)
from torchkcreg.visualization import case_figure

_NODES = 4000  # number of implant nodes whose true positions are written
RECIPE, TRUTH = "recipe.yaml", "truth.json"
_OWN = {RECIPE, TRUTH, "implant.stl", "implant.json", "geometry.json", "screws.json", "background.json", "spectrum.csv"}


@dataclass(frozen=True)
class SimulatedFiles:
    """A simulated case.

    Attributes:
        folder: The case folder.
        configurations: Names of the configurations; images are `NAME.npz`.
        made: Number of configurations simulated by this call; the others existed.
    """

    folder: Path
    configurations: tuple[str, ...]
    made: int

    def __str__(self) -> str:
        existing = len(self.configurations) - self.made
        return f"{self.made} configurations made{f', {existing} kept' if existing else ''}; folder {self.folder}"


def simulate_files(
    recipe: Path | Recipe, out: Path, *, overwrite: bool = False, figures: bool = True, progress: bool = True
) -> SimulatedFiles:
    """Write the case folder of a recipe: implant, screws, geometry, spectrum, images of each configuration, truth.

    `NAME.npz` holds the images of a configuration, `NAME_implant.stl` the implant under load, `truth.json` the true
    positions of beads, nodes and fragments. Configurations from an earlier call with the same recipe are kept.

    Args:
        recipe: YAML or JSON file, with file names relative to it; or a `Recipe`, with file names relative to the
            current folder.
        out: Output folder.
        overwrite: Replace a case that was made from another recipe.
        figures: Draw some views of each configuration.
        progress: Show a progress bar.

    Raises:
        ValueError: If the recipe is invalid, or its parts do not fit together.
        FileNotFoundError: If a file named by the recipe is missing.
        FileExistsError: If the folder holds another case or other files.
    """
    folder = Path(recipe).parent if isinstance(recipe, (str, Path)) else Path()
    checked_recipe = recipe if isinstance(recipe, Recipe) else Recipe.of(read_config(recipe), f"recipe {recipe}")
    checked_recipe, out = recipe_in(checked_recipe, folder), Path(out)
    phantom, geometry, spectrum = read_specimen(checked_recipe)
    _take(out, checked_recipe, overwrite)
    _write_specimen(out, phantom, geometry, spectrum)
    truth = _truth_so_far(out, phantom)
    finished = {entry["name"] for entry in truth["cfg"]}
    missing = checked_recipe.configurations.keys() - finished
    if missing:
        nodes = _nodes(phantom)
        for acquisition in acquisitions(phantom, geometry, spectrum, progress=progress, kept=finished):
            write_projections(
                out / f"{acquisition.name}.npz",
                intensity=acquisition.counts,
                open_beam=checked_recipe.panel.open_beam + checked_recipe.panel.offset,
            )
            write_mesh(out / f"{acquisition.name}_implant.stl", acquisition.loaded.mesh(phantom.implant))
            truth["cfg"].append(_truth_of(acquisition, phantom, nodes))
            truth["cfg"].sort(key=lambda entry: list(checked_recipe.configurations).index(entry["name"]))
            write_json(out / TRUTH, truth)
            if figures:
                lines = -(acquisition.counts.double().clamp_min(1) / checked_recipe.panel.open_beam).log()
                write_figure(out / f"{acquisition.name}.png", case_figure(lines, geometry, title=acquisition.name))
    return SimulatedFiles(out, tuple(checked_recipe.configurations), len(missing))


def read_specimen(recipe: Recipe) -> tuple[Specimen, ConeBeamGeometry, Spectrum]:
    """Specimen, views and detected spectrum of a recipe; all files it names are read and checked.

    Raises:
        ValueError: If a file is malformed, or a material is unknown.
        FileNotFoundError: If a file is missing.
    """
    files = recipe_files(recipe)
    meshes = {name: read_mesh(files[name]) for name in ("implant", "bone", "tissue") if name in files}
    screws = read_components(files["screws"]) if "screws" in files else None
    tube, panel = recipe.tube, recipe.panel
    if "spectrum" in files:
        spectrum = read_spectrum(files["spectrum"])
    else:
        spectrum = tungsten_spectrum(
            tube.voltage, filtration_mm=tube.filtration, csi_mm=panel.scintillator, anode_deg=tube.anode
        )
    geometry = read_geometry(files["geometry"]) if "geometry" in files else views_of(recipe.scanner)
    phantom = specimen(recipe, screws=screws, **meshes)
    for name in (recipe.implant.material, *(screw.material for screw in phantom.screws)):
        material(name)
    return phantom, geometry, spectrum


def _take(out: Path, recipe: Recipe, overwrite: bool) -> None:
    recipe_file = out / RECIPE
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"case folder {out} cannot be made: a file is in the way")
    record = plain(recipe.model_dump(mode="json"))
    if recipe_file.exists():
        before = read_config(recipe_file)
        if before == record:
            return
        if not overwrite:
            raise FileExistsError(f"folder {out} holds a case of another recipe: replace it with --overwrite")
        for name in before.get("configurations") or {}:
            for ending in (".npz", ".png", "_implant.stl"):
                (out / f"{name}{ending}").unlink(missing_ok=True)
        (out / TRUTH).unlink(missing_ok=True)
    elif out.is_dir() and (foreign := sorted({path.name for path in out.iterdir()} - _OWN)):
        raise FileExistsError(f"folder {out} holds something else ({foreign[0]}): choose another one")
    out.mkdir(parents=True, exist_ok=True)
    write_config(recipe_file, record)


def _write_specimen(out: Path, phantom: Specimen, geometry: ConeBeamGeometry, spectrum: Spectrum) -> None:
    material_name = phantom.recipe.implant.material
    write_mesh(out / "implant.stl", phantom.implant)
    properties = {
        "units": "mm",
        "material": material_name,
        "density_g_cm3": material(material_name).density_g_cm3,
        "volume_mm3": float(phantom.implant.volume),
    }
    write_json(out / "implant.json", properties)
    write_geometry(out / "geometry.json", geometry)
    write_components(out / "screws.json", phantom.screws)
    write_spectrum(out / "spectrum.csv", spectrum)
    if rods := _background(phantom):
        write_json(out / "background.json", {"units": "mm", "frame": "world; these do not move", "cylinders": rods})


def _background(phantom: Specimen) -> list[dict[str, Any]]:
    limb = phantom.recipe.limb
    rods = [
        {"a": list(rod.start), "b": list(rod.end), "r": rod.radius, "material": rod.substance} for rod in limb.inserts
    ]
    if limb.tissue is None or limb.tissue.radius is None:
        return rods
    x, y, z = limb.axis
    half = limb.tissue.half_length
    soft_tissue = {
        "a": [x, y, z - half],
        "b": [x, y, z + half],
        "r": limb.tissue.radius,
        "material": limb.tissue.material,
    }
    return [soft_tissue, *({**rod, "displaces": limb.tissue.material} for rod in rods)]


def _truth_so_far(out: Path, phantom: Specimen) -> dict[str, Any]:
    path = out / TRUTH
    if path.exists():
        truth = read_json(path, "truth")
        configurations = [entry for entry in truth["cfg"] if (out / f"{entry['name']}.npz").exists()]
        return {**truth, "cfg": configurations}
    return {"units": "mm", "bb_reference_mm": _listed(phantom.beads()), "cfg": []}


def _truth_of(acquisition: Acquisition, phantom: Specimen, nodes: Tensor) -> dict[str, Any]:
    state = acquisition.loaded
    truth = {
        "name": acquisition.name,
        "bb_mm": phantom.beads_after(state.fragments).tolist(),
        "nodes_undeformed_mm": _listed(nodes),
        "nodes_deformed_mm": _listed(state.implant(nodes)),
        "fragments": {name: motion.tolist() for name, motion in state.fragments.items()},
        "scatter_to_primary": acquisition.scatter_to_primary,
    }
    if state.carried is not None:
        loads = zip(state.carried.heights.tolist(), state.carried.section_loads.tolist(), strict=True)
        truth["carried"] = [{"height_mm": height, "forces_n_moments_nmm": load} for height, load in loads]
    return truth


def _nodes(phantom: Specimen) -> Tensor:
    """Sample of nodes (N, 3) of the undeformed implant, uniform in its volume."""
    nodes = ImplantPointCloud.from_mesh(phantom.implant, pitch=1.0, dtype=torch.float64).points
    order = torch.randperm(len(nodes), generator=torch.Generator(device="cpu").manual_seed(0), device="cpu")
    return nodes[order[:_NODES].sort().values]


def _listed(points: Tensor) -> Sequence[Sequence[float]]:
    return [[round(x, 6) for x in point] for point in points.tolist()]

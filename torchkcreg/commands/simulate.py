"""A simulated experiment from its recipe to a case folder: files as a registration reads them, and the truth."""

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

_NODES = 4000  # of the implant, whose true places are written
RECIPE, TRUTH = "recipe.yaml", "truth.json"
_OWN = {RECIPE, TRUTH, "implant.stl", "implant.json", "geometry.json", "screws.json", "background.json", "spectrum.csv"}


@dataclass(frozen=True)
class SimulatedFiles:
    """A case folder.

    Attributes:
        folder: Where it is.
        configurations: Names of the images, `NAME.npz`.
        made: How many were made now; the others were there.
    """

    folder: Path
    configurations: tuple[str, ...]
    made: int

    def __str__(self) -> str:
        kept = len(self.configurations) - self.made
        return f"{self.made} configurations made{f', {kept} kept' if kept else ''}; folder {self.folder}"


def simulate_files(
    recipe: Path | Recipe, out: Path, *, overwrite: bool = False, figures: bool = True, progress: bool = True
) -> SimulatedFiles:
    """The case folder of a recipe: implant, screws, geometry, spectrum, images of each configuration, truth.

    `NAME.npz` holds the images of a configuration, `NAME_implant.stl` the implant under load, `truth.json` where beads,
    nodes and fragments are. Configurations that an earlier call with the same recipe has made are kept.

    Args:
        recipe: YAML or JSON file; files that it names are relative to it. A recipe itself names files as they are.
        out: Folder to make.
        overwrite: Replace a case of another recipe.
        figures: Draw the first views.
        progress: Show it.

    Raises:
        ValueError: If the recipe is wrong, or its parts do not fit.
        FileNotFoundError: If a file that it names is missing.
        FileExistsError: If the folder holds another case, or something else.
    """
    folder = Path(recipe).parent if isinstance(recipe, (str, Path)) else Path()
    asked = recipe if isinstance(recipe, Recipe) else Recipe.of(read_config(recipe), f"recipe {recipe}")
    asked, out = recipe_in(asked, folder), Path(out)
    whole, geometry, spectrum = read_specimen(asked)
    _take(out, asked, overwrite)
    _write_specimen(out, whole, geometry, spectrum)
    truth = _truth_so_far(out, whole)
    have = {entry["name"] for entry in truth["cfg"]}
    left = asked.configurations.keys() - have
    if left:
        nodes = _nodes(whole)
        for taken in acquisitions(whole, geometry, spectrum, progress=progress, kept=have):
            write_projections(
                out / f"{taken.name}.npz",
                intensity=taken.counts,
                open_beam=asked.panel.open_beam + asked.panel.offset,
            )
            write_mesh(out / f"{taken.name}_implant.stl", taken.loaded.mesh(whole.implant))
            truth["cfg"].append(_truth_of(taken, whole, nodes))
            truth["cfg"].sort(key=lambda entry: list(asked.configurations).index(entry["name"]))
            write_json(out / TRUTH, truth)
            if figures:
                lines = -(taken.counts.double().clamp_min(1) / asked.panel.open_beam).log()
                write_figure(out / f"{taken.name}.png", case_figure(lines, geometry, title=taken.name))
    return SimulatedFiles(out, tuple(asked.configurations), len(left))


def read_specimen(recipe: Recipe) -> tuple[Specimen, ConeBeamGeometry, Spectrum]:
    """The specimen, the views and the detected spectrum of a recipe; everything that it names is read and checked.

    Raises:
        ValueError: If a file is malformed, or a material is not known.
        FileNotFoundError: If one is missing.
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
    made = specimen(recipe, screws=screws, **meshes)
    for name in (recipe.implant.material, *(screw.material for screw in made.screws)):
        material(name)
    return made, geometry, spectrum


def _take(out: Path, recipe: Recipe, overwrite: bool) -> None:
    kept = out / RECIPE
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"case folder {out} cannot be made: a file is in the way")
    record = plain(recipe.model_dump(mode="json"))
    if kept.exists():
        before = read_config(kept)
        if before == record:
            return
        if not overwrite:
            raise FileExistsError(f"folder {out} holds a case of another recipe: replace it with --overwrite")
        for name in before.get("configurations") or {}:
            for ending in (".npz", ".png", "_implant.stl"):
                (out / f"{name}{ending}").unlink(missing_ok=True)
        (out / TRUTH).unlink(missing_ok=True)
    elif out.is_dir() and (others := sorted({path.name for path in out.iterdir()} - _OWN)):
        raise FileExistsError(f"folder {out} holds something else ({others[0]}): choose another one")
    out.mkdir(parents=True, exist_ok=True)
    write_config(kept, record)


def _write_specimen(out: Path, whole: Specimen, geometry: ConeBeamGeometry, spectrum: Spectrum) -> None:
    of = whole.recipe.implant.material
    write_mesh(out / "implant.stl", whole.implant)
    about = {
        "units": "mm",
        "material": of,
        "density_g_cm3": material(of).density_g_cm3,
        "volume_mm3": float(whole.implant.volume),
    }
    write_json(out / "implant.json", about)
    write_geometry(out / "geometry.json", geometry)
    write_components(out / "screws.json", whole.screws)
    write_spectrum(out / "spectrum.csv", spectrum)
    if rods := _background(whole):
        write_json(out / "background.json", {"units": "mm", "frame": "world; these do not move", "cylinders": rods})


def _background(whole: Specimen) -> list[dict[str, Any]]:
    limb = whole.recipe.limb
    rods = [
        {"a": list(rod.start), "b": list(rod.end), "r": rod.radius, "material": rod.substance} for rod in limb.inserts
    ]
    if limb.tissue is None or limb.tissue.radius is None:
        return rods
    x, y, z = limb.axis
    half = limb.tissue.half_length
    around = {"a": [x, y, z - half], "b": [x, y, z + half], "r": limb.tissue.radius, "material": limb.tissue.material}
    return [around, *({**rod, "displaces": limb.tissue.material} for rod in rods)]


def _truth_so_far(out: Path, whole: Specimen) -> dict[str, Any]:
    path = out / TRUTH
    if path.exists():
        kept = read_json(path, "truth")
        there = [entry for entry in kept["cfg"] if (out / f"{entry['name']}.npz").exists()]
        return {**kept, "cfg": there}
    return {"units": "mm", "bb_reference_mm": _listed(whole.beads()), "cfg": []}


def _truth_of(taken: Acquisition, whole: Specimen, nodes: Tensor) -> dict[str, Any]:
    state = taken.loaded
    found = {
        "name": taken.name,
        "bb_mm": whole.beads_after(state.fragments).tolist(),
        "nodes_undeformed_mm": _listed(nodes),
        "nodes_deformed_mm": _listed(state.implant(nodes)),
        "fragments": {name: motion.tolist() for name, motion in state.fragments.items()},
        "scatter_to_primary": taken.scatter_to_primary,
    }
    if state.carried is not None:
        loads = zip(state.carried.heights.tolist(), state.carried.section_loads.tolist(), strict=True)
        found["carried"] = [{"height_mm": height, "forces_n_moments_nmm": load} for height, load in loads]
    return found


def _nodes(whole: Specimen) -> Tensor:
    """Places (N, 3) in the undeformed implant, evenly among its metal."""
    nodes = ImplantPointCloud.from_mesh(whole.implant, pitch=1.0, dtype=torch.float64).points
    order = torch.randperm(len(nodes), generator=torch.Generator(device="cpu").manual_seed(0), device="cpu")
    return nodes[order[:_NODES].sort().values]


def _listed(points: Tensor) -> Sequence[Sequence[float]]:
    return [[round(x, 6) for x in point] for point in points.tolist()]

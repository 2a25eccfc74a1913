"""Build the unloaded specimen of a recipe: the implant, its screws and the limb around it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import transform_points
from torchkcreg.implant import Hole, Screw, find_holes
from torchkcreg.simulation.hardware import flared, locking_plate, mapped
from torchkcreg.simulation.loads import RodMotion

from .recipe import HeadRecipe, PlateShape, Recipe

DISTAL, PROXIMAL = "distal", "proximal"


@dataclass(frozen=True, eq=False)
class Specimen:
    """The unloaded specimen of a recipe. The world's frame is the implant's.

    Attributes:
        recipe: The recipe.
        implant: Closed mesh of the implant, mm.
        holes: Screw holes of the implant.
        screws: Screws of the implant.
        bone: Mesh of a bone that does not move; None if the recipe has none.
        tissue: Mesh of the surrounding tissue; None if the recipe has none.
    """

    recipe: Recipe
    implant: trimesh.Trimesh
    holes: list[Hole]
    screws: list[Screw]
    bone: trimesh.Trimesh | None = None
    tissue: trimesh.Trimesh | None = None

    @property
    def fracture(self) -> float:
        """Height of the fracture between the fragments, mm."""
        return self.recipe.limb.bone.gap_at if self.recipe.limb.bone is not None else 0.0

    def fragment_of(self, height: float) -> str:
        """Name of the fragment at a height: distal below the fracture, proximal above."""
        return DISTAL if height < self.fracture else PROXIMAL

    def beads(self) -> Tensor:
        """Centres of the beads without load (B, 3), mm."""
        return torch.tensor(self.recipe.limb.beads, dtype=torch.float64, device="cpu").reshape(-1, 3)

    def beads_after(self, fragments: Mapping[str, Tensor]) -> Tensor:
        """Centres of the beads (B, 3), mm, after rigid motions (4, 4) of the fragments."""
        beads = self.beads()
        moved = [transform_points(fragments[self.fragment_of(float(bead[2]))], bead[None]) for bead in beads]
        return torch.cat([beads[:0], *moved])

    def holds(self, number: int) -> bool:
        """True if the screw of this number holds in its fragment."""
        return number not in self.recipe.screws.loose

    @property
    def head(self) -> HeadRecipe | None:
        """Screw heads that are imaged but not in the list of screws."""
        return self.recipe.screws.heads


def parametric_plate(shape: PlateShape) -> trimesh.Trimesh:
    """Mesh of a recipe's contoured plate.

    Raises:
        ValueError: If the shape is impossible, such as holes wider than the plate.
    """
    plate = locking_plate(
        length=shape.length,
        width=shape.width,
        thickness=shape.thickness,
        num_holes=shape.holes,
        hole_radius=shape.hole_radius,
        hole_offset=shape.hole_offset,
    )
    plate = flared(plate, shape.length, shape.flare)
    if not (shape.bow or shape.twist):
        return plate
    rates = torch.deg2rad(torch.tensor([shape.bow, 0.0, shape.twist], dtype=torch.float64)) / shape.length
    half = shape.length / 2
    return mapped(plate, RodMotion(lambda z: rates.expand(len(z), 3), (-half, half)))


def specimen(
    recipe: Recipe,
    *,
    implant: trimesh.Trimesh | None = None,
    screws: list[Screw] | None = None,
    bone: trimesh.Trimesh | None = None,
    tissue: trimesh.Trimesh | None = None,
) -> Specimen:
    """Build the specimen of a recipe.

    Args:
        recipe: The recipe.
        implant: Mesh from the recipe's implant file; None for a parametric plate.
        screws: Screws from the recipe's file; None for screws in holes.
        bone: Mesh from the recipe's bone file, if it has one.
        tissue: Mesh from the recipe's tissue file, if it has one.

    Raises:
        ValueError: If a screw is to go into a hole that the implant does not have, a screw that is not there is loose,
            the implant's mesh is missing, or a mesh is not closed.
    """
    shape = recipe.implant.plate
    if implant is None and shape is not None:
        implant = parametric_plate(shape)
    if implant is None:
        raise ValueError("the recipe names an implant's mesh, but there is none")
    for name, mesh in (("implant", implant), ("bone", bone), ("tissue", tissue)):
        if mesh is not None and not mesh.is_watertight:
            raise ValueError(f"the {name}'s mesh must be closed")
    holes = sorted(find_holes(implant), key=lambda hole: float(hole.center[2]))
    if screws is None:
        screws = _screws_in_holes(recipe, holes)
    if any(not 0 <= number < len(screws) for number in recipe.screws.loose):
        raise ValueError(f"screws.loose must be numbers of the {len(screws)} screws, got {recipe.screws.loose}")
    return Specimen(recipe, implant, holes, screws, bone, tissue)


def _screws_in_holes(recipe: Recipe, holes: list[Hole]) -> list[Screw]:
    screw_recipe, rng = recipe.screws, np.random.default_rng([recipe.seed, 31])
    places = _places(holes)
    if (screw_recipe.holes and max(screw_recipe.holes) >= len(places)) or min(screw_recipe.holes, default=0) < 0:
        raise ValueError(f"screws.holes must be among the {len(places)} holes of the implant, got {screw_recipe.holes}")
    screws = []
    for number, place in enumerate(screw_recipe.holes):
        hole = places[place]
        into = -hole.axis if hole.axis[1] > 0 else hole.axis  # the bone is at negative y
        direction = _tilted(into, math.radians(screw_recipe.tilt), rng)
        start = hole.center - into * hole.depth / 2
        end = start + screw_recipe.length * direction
        ends = tuple(start.tolist()), tuple(end.tolist())
        screws.append(
            Screw(*ends, screw_recipe.radius, screw_recipe.material or recipe.implant.material, f"screw{number}")
        )
    return screws


def _places(holes: list[Hole]) -> list[Hole]:
    """Holes from the lowest up. Of a combination hole, which is found as two holes, only the lower one is kept."""
    places: list[Hole] = []
    for hole in holes:
        if not places or np.linalg.norm(hole.center - places[-1].center) > 2.2 * hole.radius:
            places.append(hole)
    return places


def _tilted(axis: np.ndarray, most: float, rng: np.random.Generator) -> np.ndarray:
    if most == 0:
        return axis
    aside = np.cross(axis, rng.normal(size=3))
    angle = most * rng.uniform(0.4, 1.0)
    return math.cos(angle) * axis + math.sin(angle) * aside / np.linalg.norm(aside)


def recipe_files(recipe: Recipe) -> dict[str, Path]:
    """Files of a recipe, by content (implant, screws, bone, tissue, spectrum, geometry)."""
    limb, tissue = recipe.limb, recipe.limb.tissue
    named = {
        "implant": recipe.implant.mesh,
        "screws": recipe.screws.file,
        "bone": limb.mesh,
        "tissue": None if tissue is None else tissue.mesh,
        "spectrum": recipe.tube.spectrum,
        "geometry": recipe.scanner.geometry,
    }
    return {content: path for content, path in named.items() if path is not None}


def recipe_in(recipe: Recipe, folder: Path) -> Recipe:
    """Recipe with absolute paths, resolved against the folder of its file."""
    limb, tissue = recipe.limb, recipe.limb.tissue

    def full(path: Path | None) -> Path | None:
        return None if path is None else (folder / path).resolve()

    changed = {
        "implant": recipe.implant.model_copy(update={"mesh": full(recipe.implant.mesh)}),
        "screws": recipe.screws.model_copy(update={"file": full(recipe.screws.file)}),
        "limb": limb.model_copy(
            update={
                "mesh": full(limb.mesh),
                "tissue": None if tissue is None else tissue.model_copy(update={"mesh": full(tissue.mesh)}),
            }
        ),
        "tube": recipe.tube.model_copy(update={"spectrum": full(recipe.tube.spectrum)}),
        "scanner": recipe.scanner.model_copy(update={"geometry": full(recipe.scanner.geometry)}),
    }
    return recipe.model_copy(update=changed)

"""A specimen out of a recipe: the implant, its screws and the limb around it, without load."""

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
    """What a recipe describes, before any load; the implant's frame is the world's.

    Attributes:
        recipe: What it was made of.
        implant: Closed mesh, mm.
        holes: Of it.
        screws: Of it.
        bone: Mesh of a bone that does not move, where the recipe has one.
        tissue: Mesh of what is around, where the recipe has one.
    """

    recipe: Recipe
    implant: trimesh.Trimesh
    holes: list[Hole]
    screws: list[Screw]
    bone: trimesh.Trimesh | None = None
    tissue: trimesh.Trimesh | None = None

    @property
    def fracture(self) -> float:
        """Height that parts the fragments, mm."""
        return self.recipe.limb.bone.gap_at if self.recipe.limb.bone is not None else 0.0

    def fragment_of(self, height: float) -> str:
        """The fragment at a height: distal below the fracture, proximal above."""
        return DISTAL if height < self.fracture else PROXIMAL

    def beads(self) -> Tensor:
        """Their centres (B, 3), mm."""
        return torch.tensor(self.recipe.limb.beads, dtype=torch.float64, device="cpu").reshape(-1, 3)

    def beads_after(self, fragments: Mapping[str, Tensor]) -> Tensor:
        """Where rigid motions (4, 4) of the fragments take them, (B, 3), mm."""
        beads = self.beads()
        moved = [transform_points(fragments[self.fragment_of(float(bead[2]))], bead[None]) for bead in beads]
        return torch.cat([beads[:0], *moved])

    @property
    def head(self) -> HeadRecipe | None:
        """What screws have that no list knows."""
        return self.recipe.screws.heads


def parametric_plate(shape: PlateShape) -> trimesh.Trimesh:
    """A contoured plate as a recipe describes it.

    Raises:
        ValueError: If it is impossible, such as holes wider than the plate.
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
    """The specimen of a recipe.

    Args:
        recipe: What it is made of.
        implant, screws, bone, tissue: What the files hold that the recipe names.

    Raises:
        ValueError: If a screw is asked for in a hole that the implant does not have, or a mesh is not closed.
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
    return Specimen(recipe, implant, holes, screws, bone, tissue)


def _screws_in_holes(recipe: Recipe, holes: list[Hole]) -> list[Screw]:
    wanted, rng = recipe.screws, np.random.default_rng([recipe.seed, 31])
    places = _places(holes)
    if (wanted.holes and max(wanted.holes) >= len(places)) or min(wanted.holes, default=0) < 0:
        raise ValueError(f"screws.holes must be among the {len(places)} holes of the implant, got {wanted.holes}")
    found = []
    for number, place in enumerate(wanted.holes):
        hole = places[place]
        into = -hole.axis if hole.axis[1] > 0 else hole.axis  # the bone is on the side of negative y
        direction = _tilted(into, math.radians(wanted.tilt), rng)
        start = hole.center - into * hole.depth / 2
        end = start + wanted.length * direction
        ends = tuple(start.tolist()), tuple(end.tolist())
        found.append(Screw(*ends, wanted.radius, wanted.material or recipe.implant.material, f"screw{number}"))
    return found


def _places(holes: list[Hole]) -> list[Hole]:
    """Holes from the lowest up; a combination hole, found as two, is its lower one."""
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
    """Files that a recipe names, by what they are."""
    limb, tissue = recipe.limb, recipe.limb.tissue
    named = {
        "implant": recipe.implant.mesh,
        "screws": recipe.screws.file,
        "bone": limb.mesh,
        "tissue": None if tissue is None else tissue.mesh,
        "spectrum": recipe.tube.spectrum,
        "geometry": recipe.scanner.geometry,
    }
    return {what: path for what, path in named.items() if path is not None}


def recipe_in(recipe: Recipe, folder: Path) -> Recipe:
    """A recipe whose files are named in full, so that it may lie anywhere."""
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

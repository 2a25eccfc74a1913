"""Bodies in a simulated beam, and their path lengths by material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from torchkcreg.projector.mesh import project_mesh

from .solids import Solid, chord_image


@dataclass(frozen=True, eq=False)
class Part:
    """A body of one material.

    Attributes:
        name: Unique among the parts.
        shape: A closed mesh, or a solid with closed-form chords, in the world's frame.
        material: Name of a packaged material.
        displaces: Names of the solids that this part displaces where they overlap, as a screw does in a bone. This part
            must be a solid without a cavity. Parts that displace the same solid must not overlap each other.
        inside: Name of a part that contains this one completely and is displaced by it: soft tissue, a water bath.
    """

    name: str
    shape: trimesh.Trimesh | Solid
    material: str
    displaces: tuple[str, ...] = ()
    inside: str | None = None


def material_paths(parts: Sequence[Part], matrix: Tensor, det_shape: tuple[int, int]) -> dict[str, Tensor]:
    """Path lengths of one view by material (rows, cols), mm, float64, without the displaced volumes.

    Args:
        parts: Bodies in the beam.
        matrix: Projection matrix (3, 4).
        det_shape: Rows and columns.

    Raises:
        ValueError: If two parts share a name, a part refers to an unknown one, a mesh is not closed, or a mesh
            displaces a part or is displaced.
    """
    by_name = {part.name: part for part in parts}
    if len(by_name) != len(parts):
        raise ValueError(f"parts must have unique names, got {[part.name for part in parts]}")
    lengths = {part.name: _path(part, matrix, det_shape) for part in parts}
    for part in parts:
        for name in part.displaces:
            pusher = part.shape
            pushed = _named(by_name, name, part).shape
            if isinstance(pusher, trimesh.Trimesh) or isinstance(pushed, trimesh.Trimesh):
                raise ValueError(f"parts that displace each other must be solids, got a mesh in {part.name} or {name}")
            lengths[name] = lengths[name] - chord_image(pushed, matrix, det_shape, within=pusher)
    net = dict(lengths)
    for part in parts:
        if part.inside is not None:
            around = _named(by_name, part.inside, part).name
            net[around] = net[around] - lengths[part.name]
    total: dict[str, Tensor] = {}
    for part in parts:
        total[part.material] = total.get(part.material, 0) + net[part.name]
    return total


def _path(part: Part, matrix: Tensor, det_shape: tuple[int, int]) -> Tensor:
    """Path lengths (rows, cols) of one part, ignoring all others."""
    if not isinstance(part.shape, trimesh.Trimesh):
        return chord_image(part.shape, matrix, det_shape)
    if not part.shape.is_watertight:
        raise ValueError(f"mesh of part {part.name} must be closed")
    vertices, faces = torch.tensor(part.shape.vertices), torch.tensor(part.shape.faces)
    return project_mesh(vertices.double(), faces, matrix[None], det_shape)[0]


def _named(parts: dict[str, Part], name: str, by: Part) -> Part:
    """Part with the given name, to which part `by` refers."""
    if name not in parts:
        raise ValueError(f"part {by.name} must refer to one of {', '.join(parts)}, got {name!r}")
    return parts[name]

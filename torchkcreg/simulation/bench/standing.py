"""Bodies in the beam: a specimen's parts in their loaded positions, each inside or outside the tissue."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchkcreg.simulation.parts import Part
from torchkcreg.simulation.solids import Cylinder, Solid, Sphere, Tube

from .loaded import Loaded
from .specimen import DISTAL, PROXIMAL, Specimen

_TISSUE = "tissue"
_MARROW_GAP_MM = 1e-3
_SAMPLES = 400  # points along an axis
_SECTIONS = 64  # facets around a drilled hole


def parts_in_beam(specimen: Specimen, state: Loaded) -> list[Part]:
    """Implant, screws, bone, beads, inserts and tissue in their loaded positions.

    Raises:
        ValueError: If a part lies half inside the tissue, an insert reaches into a bone, or screws go through a bone's
            mesh and manifold3d is not installed.
    """
    limb, recipe = specimen.recipe.limb, specimen.recipe
    tissue = _tissue(specimen)
    tissue_shape = None if tissue is None else tissue.shape
    parts = [_placed("plate", state.mesh(specimen.implant), recipe.implant.material, tissue_shape)]
    shafts = []
    for number, (screw, motion) in enumerate(zip(specimen.screws, state.screws, strict=True)):
        shaft = Cylinder(_tensor(screw.start), _tensor(screw.end), screw.radius)
        shafts.append(shaft.moved(motion))
        pushed = _pushed(specimen, screw.start[2])
        parts.append(_placed(f"screw{number}", shafts[-1], screw.material, tissue_shape, pushed))
        if specimen.head is not None:
            up = (shaft.start - shaft.end) / (shaft.start - shaft.end).norm()
            cap = Cylinder(shaft.start, shaft.start + specimen.head.height * up, specimen.head.radius).moved(motion)
            parts.append(_placed(f"head{number}", cap, screw.material, tissue_shape))
    parts += _bones(specimen, state, shafts, tissue_shape)
    for number, center in enumerate(specimen.beads_after(state.fragments)):
        parts.append(_placed(f"bead{number}", Sphere(center, limb.bead_radius), "steel", tissue_shape))
    bones = [part for part in parts if isinstance(part.shape, Tube)]
    for number, rod in enumerate(limb.inserts):
        for bone in bones:
            _check_apart(f"insert{number}", (_tensor(rod.start), _tensor(rod.end)), rod.radius, bone)
        parts.append(
            _placed(
                f"insert{number}",
                Cylinder(_tensor(rod.start), _tensor(rod.end), rod.radius),
                rod.substance,
                tissue_shape,
            )
        )
    return parts if tissue is None else [*parts, tissue]


def _check_apart(name: str, ends: tuple[Tensor, Tensor], radius: float, bone: Part) -> None:
    """Raise ValueError if a rod reaches into a bone: the overlap would be counted twice."""
    share = torch.linspace(0, 1, _SAMPLES, dtype=torch.float64, device="cpu")[:, None]
    assert isinstance(bone.shape, Tube)  # as `_bones` makes it
    axis = torch.lerp(bone.shape.start, bone.shape.end, share)
    if float(torch.cdist(torch.lerp(*ends, share), axis).min()) < radius + bone.shape.outer_radius:
        raise ValueError(f"{name} reaches into the {bone.name} bone: they must not overlap")


def _pushed(specimen: Specimen, height: float) -> tuple[str, ...]:
    """Names of the parts that a screw may displace."""
    limb, fragment = specimen.recipe.limb, specimen.fragment_of(height)
    names = []
    if limb.bone is not None:
        names += [fragment] + ([f"{fragment} marrow"] if limb.bone.marrow else [])
    return tuple(names + [f"insert{number}" for number in range(len(limb.inserts))])


def _bones(
    specimen: Specimen, state: Loaded, shafts: list[Cylinder], tissue: trimesh.Trimesh | Solid | None
) -> list[Part]:
    limb, bone = specimen.recipe.limb, specimen.recipe.limb.bone
    parts = []
    if specimen.bone is not None:
        parts.append(_placed("bone", _drilled(specimen.bone, shafts), limb.mesh_material, tissue))
    if bone is None:
        return parts
    for fragment, side in ((DISTAL, -1.0), (PROXIMAL, 1.0)):
        low, high = (bone.gap_at + side * x for x in (bone.gap / 2, bone.reach))
        near, far = (_tensor((bone.axis[0], bone.axis[1], z)) for z in (low, high))
        motion = state.fragments[fragment]
        tube = Tube(near, far, bone.outer_radius, bone.inner_radius).moved(motion)
        parts.append(_placed(fragment, tube, bone.material, tissue))
        if bone.marrow is not None:
            core = Cylinder(near, far, bone.inner_radius - _MARROW_GAP_MM).moved(motion)
            parts.append(_placed(f"{fragment} marrow", core, bone.marrow, tissue))
    return parts


def _drilled(bone: trimesh.Trimesh, shafts: list[Cylinder]) -> trimesh.Trimesh:
    """Bone mesh with the screw holes cut out."""
    for shaft in shafts:
        drill = trimesh.creation.cylinder(
            shaft.radius, segment=torch.stack([shaft.start, shaft.end]).numpy(), sections=_SECTIONS
        )
        if not bool((bone.bounds[0] < drill.bounds[1]).all() and (drill.bounds[0] < bone.bounds[1]).all()):
            continue
        try:
            import manifold3d  # noqa: F401
        except ImportError:
            raise ValueError("screws in a bone's mesh need manifold3d: pip install 'torchkcreg[simulate]'") from None
        bone = trimesh.boolean.difference([bone, drill], engine="manifold")
    return bone


def _tissue(specimen: Specimen) -> Part | None:
    recipe = specimen.recipe.limb.tissue
    if recipe is None:
        return None
    if specimen.tissue is not None:
        return Part(_TISSUE, specimen.tissue, recipe.material)
    middle = specimen.recipe.limb.axis
    low, high = (_tensor((middle[0], middle[1], middle[2] + side * recipe.half_length)) for side in (-1.0, 1.0))
    assert recipe.radius is not None  # a tissue without a mesh has a radius
    return Part(_TISSUE, Cylinder(low, high, recipe.radius), recipe.material)


def _placed(
    name: str,
    shape: trimesh.Trimesh | Solid,
    material: str,
    tissue: trimesh.Trimesh | Solid | None,
    displaces: tuple[str, ...] = (),
) -> Part:
    """Part inside or outside the tissue."""
    if tissue is None:
        return Part(name, shape, material, displaces)
    points = _outline(shape)
    if isinstance(tissue, trimesh.Trimesh):
        inside = torch.from_numpy(tissue.contains(points.numpy()))
    else:
        assert isinstance(tissue, Cylinder)  # as `_tissue` makes it
        axis, length = tissue.end - tissue.start, float((tissue.end - tissue.start).norm())
        along = (points - tissue.start) @ axis / length
        across = (points - tissue.start - along[:, None] * axis / length).norm(dim=1)
        inside = (across <= tissue.radius) & (along >= 0) & (along <= length)
    if bool(inside.any()) and not bool(inside.all()):
        raise ValueError(f"the tissue must hold all of {name} or nothing of it")
    return Part(name, shape, material, displaces, _TISSUE if bool(inside.all()) else None)


def _outline(shape: trimesh.Trimesh | Solid) -> Tensor:
    """Points (n, 3) on the surface of a shape that span its extent."""
    if isinstance(shape, trimesh.Trimesh):
        return torch.from_numpy(np.array(shape.vertices))
    if isinstance(shape, Sphere):
        axes = torch.eye(3, dtype=torch.float64, device="cpu") * shape.radius
        return shape.center + torch.cat([axes, -axes])
    radius = shape.outer_radius if isinstance(shape, Tube) else shape.radius
    axis = shape.end - shape.start
    first = torch.linalg.cross(axis, torch.eye(3, dtype=axis.dtype, device="cpu")[axis.abs().argmin()])
    across = torch.stack(
        [first / first.norm(), torch.linalg.cross(axis, first) / torch.linalg.cross(axis, first).norm()]
    )
    rim = torch.cat([across, -across]) * radius
    return torch.cat([shape.start + rim, shape.end + rim])


def _tensor(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64, device="cpu")

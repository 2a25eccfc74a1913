"""Start of a registration: the given pose if it agrees with the images, else a search for the implant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchkcreg.geometry import rotation_grid, transform_points
from torchkcreg.physics import material
from torchkcreg.progress import progress_bar
from torchkcreg.projector import project_points
from torchkcreg.scene import Assembly, RegistrationData, Scene
from torchkcreg.search import Body, Candidates, PoseSearch, spread_views

from .config import RegistrationConfig
from .verdict import Rival

_ROTATIONS, _PLACED = 256, 32  # of a quick search that a given start is compared with
_AGREES = 0.85  # times the best similarity of the quick search: a start that agrees is at least so similar
_OTHERS_PITCH_MM = 2.0
# Candidates that the rigid stages are run from, and their least similarity relative to the best.
_TRIED, _WORSE = 8, 0.7
_TRIAL_VIEWS = 6
_ENERGY_KEV, _UNNAMED = 60.0, "steel"

Trial = Callable[[Scene, RegistrationData], float]


@dataclass(frozen=True)
class FoundStart:
    """Outcome of a search.

    Attributes:
        names: Implants that were searched.
        rival: Second best pose of the implant searched last; None if there was only one, or no search.
    """

    names: tuple[str, ...] = ()
    rival: Rival | None = None


@torch.no_grad()
def find_start(scene: Scene, data: RegistrationData, config: RegistrationConfig, trial: Trial) -> FoundStart:
    """Move implants whose start does not agree with the images to where a search finds them.

    Several implants are searched one after the other, the largest first, each beside those that are in place. The most
    similar poses of the search are compared by the misfit after the rigid stages, which see screws and contrast.

    Args:
        scene: Scene at its start.
        data: Measured images.
        config: Its `start` says whether to search: "auto", "given" (never) or "search" (always).
        trial: Runs the rigid stages on a scene and data, and returns the misfit.
    """
    if config.start == "given":
        return FoundStart()
    by_size = sorted(scene, key=lambda assembly: float(assembly.implant.volumes.sum()), reverse=True)

    def search_beside(assembly: Assembly, others: Sequence[Assembly]) -> PoseSearch:
        shown = partial(drawn, tuple(others)) if others else None
        return PoseSearch(data, partial(body_of, assembly), shown, attenuation=_attenuation(assembly))

    searches = {assembly.name: search_beside(assembly, ()) for assembly in by_size}
    placed = [a for a in by_size if config.start == "auto" and agrees(searches[a.name], a)]
    lost = [assembly for assembly in by_size if assembly not in placed]
    rival = None
    for assembly in lost:
        search = search_beside(assembly, placed) if placed else searches[assembly.name]
        placed.append(assembly)
        rival = _placed(assembly, search, scene.with_only(placed), data, trial)
    return FoundStart(tuple(assembly.name for assembly in lost), rival)


def _attenuation(assembly: Assembly) -> float:
    """Attenuation of an implant's metal at the mean energy of a tube, 1/mm; of iron-like metal if it is not named."""
    try:
        metal = material(assembly.material)
    except ValueError:  # without a material, path lengths have the implant's name
        metal = material(_UNNAMED)
    return float(metal.attenuation(_ENERGY_KEV))


def body_of(assembly: Assembly, pitch_mm: float) -> Body:
    """Undeformed implant and its components, on nodes about this far apart."""
    clouds = [assembly.implant, *(component.cloud for component in assembly.components)]
    coarse = [cloud.coarsened_to(pitch_mm) for cloud in clouds]
    points = torch.cat([cloud.points.double() for cloud in coarse])
    return Body.of(points, torch.cat([cloud.volumes for cloud in coarse]), coarse[0].cell)


def drawn(assemblies: Sequence[Assembly], data: RegistrationData) -> Tensor:
    """Path lengths (V, rows, cols) of implants at their present poses."""
    total = torch.zeros_like(data.line_integrals)
    for assembly in assemblies:
        body = body_of(assembly, _OTHERS_PITCH_MM)
        points = transform_points(assembly.implant_to_world, body.points + body.center).to(total)
        total = total + project_points(
            points,
            body.volumes.to(total),
            data.geometry.projection_matrices.to(total),
            data.geometry.det_shape,
            cell=body.cell.to(total) @ assembly.implant_to_world[:3, :3].mT.to(total),
        )
    return total


def agrees(search: PoseSearch, assembly: Assembly) -> bool:
    """True if the assembly's pose, moved to the nearest optimum, fits as well as the best of a quick search."""
    body, pose = search.coarse.body, assembly.implant_to_world
    start = Candidates(pose[None, :3, :3], transform_points(pose, body.center[None]), pose.new_zeros(1))
    there = float(search.coarse.refined(start, 8).similarity)
    return there >= _AGREES * float(search.placed(rotation_grid(_ROTATIONS, pose.device), _PLACED).similarity.max())


def _placed(assembly: Assembly, search: PoseSearch, scene: Scene, data: RegistrationData, trial: Trial) -> Rival | None:
    """Move an assembly of a scene to its best pose; return the second best."""
    with progress_bar(total=4, desc=f"search for the {assembly.name}") as bar:

        def report(done: int, text: str) -> None:
            bar.update(done - bar.n)
            bar.set_postfix_str(text)

        candidates = search.candidates(report)
        bar.update(4 - bar.n)
    likely = candidates[candidates.similarity > _WORSE * candidates.similarity[0]].best(_TRIED)
    poses = likely.poses(search.body).to(assembly.implant_to_world)
    if len(poses) == 1:
        assembly.implant_to_world = poses[0]
        return None
    seen = data.select(spread_views(data.geometry, _TRIAL_VIEWS)) if data.num_views > _TRIAL_VIEWS else data
    kept, ends = scene.kept(), []
    with progress_bar(total=len(poses), desc=f"poses of the {assembly.name}") as bar:
        for pose in poses:
            scene.restore(kept)
            assembly.implant_to_world = pose
            misfit = trial(scene, seen)
            ends.append((misfit, assembly.implant_to_world.clone()))
            bar.update()
    scene.restore(kept)
    ends.sort(key=lambda end: end[0])
    (best, pose), *others = ends
    assembly.implant_to_world = pose
    nodes = assembly.implant.coarsened_to(_OTHERS_PITCH_MM).points.to(pose)
    here = transform_points(pose, nodes)
    for misfit, other in others:
        distance = float((transform_points(other, nodes) - here).square().sum(-1).mean().sqrt())
        if distance > Rival.APART_MM:
            return Rival(distance_mm=distance, misfit=misfit, best_misfit=best, pose=other.tolist())
    return None

"""A small plate in front of two or three views, and its clean or physical images: quick enough for tests."""

from __future__ import annotations

import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import (
    cluster_control_points,
    control_point_volumes,
    control_points_from_groups,
    group_centers,
)
from torchkcreg.geometry import circular_geometry, rigid_matrix, rotation_from_vector
from torchkcreg.implant import Component, ImplantPointCloud
from torchkcreg.registration import Objective, RegistrationConfig, Stage, StageRun, build_scene
from torchkcreg.scene import RegistrationData, Scene
from torchkcreg.simulation import locking_plate

SCREW = Component.screw("screw", (2.0, 2.0, 15.0), (2.0, -14.0, 15.0), 1.5, pitch=0.5)
COARSE = {"optimizer": "cmaes", "iterations": 40, "tolerance": 0.1, "step_mm": 2.0, "population": 12}
RIGID = (
    Stage(bin=2, pitch_factor=2, margin_mm=15.0, **COARSE),
    Stage(oversampling=1),
    Stage(oversampling=1, tolerance=1e-4),
)

GRID = {"grid_shape": (4, 4, 6), "grid_spacing_mm": (10.0, 10.0, 12.0)}
PLAIN = RegistrationConfig(stages=RIGID, **GRID)


def plate() -> ImplantPointCloud:
    """A stepped plate of 50 x 10 x 3 mm without symmetry, on 0.5 mm cells."""
    parts = [trimesh.creation.box((10.0, 3.0, 50.0)), trimesh.creation.box((4.0, 3.0, 12.0))]
    parts[1].apply_translation((7.0, 0.0, 12.0))
    return ImplantPointCloud.from_mesh(trimesh.util.concatenate(parts), 0.5)


def geometry():
    """Three views of 160 x 96 pixels of 0.8 mm, two of them from oblique sources."""
    return circular_geometry(
        [40.0, 75.0, 110.0],
        sad=404.0,
        sdd=538.0,
        det_shape=(160, 96),
        pixel_spacing=(0.8, 0.8),
        source_z_mm=[60.0, 0.0, -60.0],
        sources=["T1", "T2", "T3"],
    )


def pose(millimetres: float, degrees: float) -> Tensor:
    """A rigid motion by so much, in a fixed oblique direction."""
    turn = torch.tensor([0.5, 0.6, -0.62], dtype=torch.float64)
    shift = torch.tensor([-0.6, 0.64, 0.48], dtype=torch.float64)
    return rigid_matrix(turn / turn.norm() * degrees * torch.pi / 180, shift / shift.norm() * millimetres)


def scene(config: RegistrationConfig, implant_to_world: Tensor | None = None, components=()) -> Scene:
    """The plate at a pose."""
    return build_scene(plate(), config, implant_to_world=implant_to_world, components=components)


def image(of: Scene, background: Tensor | None = None) -> RegistrationData:
    """What the views show of a scene."""
    views = geometry()
    blank = RegistrationData(views, torch.zeros(views.num_views, *views.det_shape), background=background)
    with torch.no_grad():
        return RegistrationData(views, of(of.view(blank)))


def objective(of: Scene, data: RegistrationData, stage: Stage, config: RegistrationConfig) -> Objective:
    """Of a stage at the scene's present state, without the steps before it."""
    return StageRun(of, data, stage, config).objective


def bend(of: Scene, radians: float) -> None:
    """Turns the upper third of the plate out of its plane."""
    (assembly,) = of.assemblies
    grid, implant = assembly.deformation.grid, assembly.implant
    labels = cluster_control_points(grid, control_point_volumes(grid, implant.points, implant.volumes), 3)
    vectors = torch.zeros(3, 3, dtype=torch.float64)
    vectors[group_centers(grid, labels)[:, 2].argmax(), 1] = radians
    motions = rotation_from_vector(vectors), torch.zeros(3, 3, dtype=torch.float64)
    with torch.no_grad():
        assembly.deformation.control_points.copy_(control_points_from_groups(grid, labels, *motions))
        assembly.deformation.labels.copy_(labels)


GRID_OF_SCREWS = {"grid_shape": (4, 4, 8), "grid_spacing_mm": (8.0, 8.0, 10.0), "pitch_mm": 0.5}


def drilled_plate() -> trimesh.Trimesh:
    """A plate of 53 x 10 x 3 mm with three holes, at z = -15, 0 and 15 mm."""
    return locking_plate(length=53.0, width=10.0, thickness=3.0, num_holes=3, hole_radius=2.0)

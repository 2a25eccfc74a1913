"""Components that turn about their heads beside following the implant."""

import pytest
import torch
import trimesh
from small_scene import GRID_OF_SCREWS, drilled_plate, image, pose

from torchkcreg.geometry import rotation_from_vector
from torchkcreg.implant import Component, ImplantPointCloud
from torchkcreg.registration import RegistrationConfig, Stage, Trainer, build_scene
from torchkcreg.scene.parameter_blocks import ComponentTilts

TIPS = {"left": (0.0, -18.0, 15.0), "right": (0.0, -18.0, -15.0)}
STAGES = (Stage(oversampling=1, tolerance=1e-4),)
CONFIG = RegistrationConfig(material="steel", stages=STAGES, prior_weight=1e-6, **GRID_OF_SCREWS)


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    return drilled_plate()


def scene_of(mesh: trimesh.Trimesh, motion: torch.Tensor | None = None):
    screws = [Component.screw(name, (0.0, 1.5, tip[2]), tip, 1.6, pitch=0.5) for name, tip in TIPS.items()]
    return build_scene(ImplantPointCloud.from_mesh(mesh, 0.5), CONFIG, implant_to_world=motion, components=screws)


def test_a_step_moves_the_far_end_by_as_many_millimetres_and_leaves_the_head(mesh: trimesh.Trimesh) -> None:
    tilts = ComponentTilts(scene_of(mesh).assemblies[0], 1.0)
    assert tilts.num_parameters == 4
    motion = tilts.motions(torch.tensor([[0.3, 0.4, 0.0, 0.0]], dtype=torch.float64))[0]
    tip, head = torch.tensor([*TIPS["left"], 1.0]).double(), torch.tensor([0.0, 1.5, 15.0, 1.0]).double()
    assert float((motion[0] @ tip - tip).norm()) == pytest.approx(0.5, rel=0.02)
    assert torch.allclose(motion[0] @ head, head)
    assert torch.equal(motion[1], torch.eye(4, dtype=torch.float64))


def test_tilted_screws_do_not_take_the_plate_along(mesh: trimesh.Trimesh) -> None:
    motion = pose(0.3, 0.2)
    true = scene_of(mesh, motion)
    true.assemblies[0].tilts = torch.tensor([[0.02, 0.0, 0.006], [0.02, 0.0, 0.01]], dtype=torch.float64)
    data = image(true)
    errors = {}
    for free in (False, True):
        scene = scene_of(mesh)
        stages = tuple(stage.model_copy(update={"estimate": ("tilts",) if free else ()}) for stage in CONFIG.stages)
        Trainer(scene, data, CONFIG.model_copy(update={"stages": stages})).run()
        errors[free] = float((scene.assemblies[0].nodes() - true.assemblies[0].nodes()).norm(dim=-1).max())
    assert errors[True] < 0.03 < 0.09 < errors[False], errors
    assert torch.allclose(scene.assemblies[0].tilts, true.assemblies[0].tilts, atol=2e-3)
    told = scene.assemblies[0].component_motions()["left"][:3, :3]
    assert torch.allclose(told, rotation_from_vector(true.assemblies[0].tilts[0]), atol=2e-3)


def test_tilts_are_kept_and_restored_with_the_scene(mesh: trimesh.Trimesh) -> None:
    data = image(scene_of(mesh))
    scene = scene_of(mesh)
    scene.assemblies[0].tilts[0, 0] = 0.01
    kept = scene.kept()
    checkpoint = Trainer(scene, data, CONFIG).state_dict()
    scene.assemblies[0].tilts[0, 0] = 0.5
    scene.restore(kept)
    assert float(scene.assemblies[0].tilts[0, 0]) == 0.01
    fresh = scene_of(mesh)
    Trainer(fresh, data, CONFIG).load_state_dict(checkpoint)
    assert float(fresh.assemblies[0].tilts[0, 0]) == 0.01

"""What a registration shares with the program around it, and what it takes up again."""

from __future__ import annotations

import pytest
import torch
import trimesh
from small_scene import PLAIN, SCREW, image, scene

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import Trainer, build_scene


def test_a_checkpoint_of_another_implant_is_refused() -> None:
    data = image(scene(PLAIN))
    state = Trainer(scene(PLAIN), data, PLAIN).state_dict()
    Trainer(scene(PLAIN), data, PLAIN).load_state_dict(state)
    other = ImplantPointCloud.from_mesh(trimesh.creation.box((9.0, 5.0, 60.0)), PLAIN.pitch_mm)
    with pytest.raises(ValueError, match=r"does not fit this registration: .*the implant's bounds"):
        Trainer(build_scene(other, PLAIN), data, PLAIN).load_state_dict(state)
    finer = PLAIN.model_copy(update={"grid_spacing_mm": (8.0, 8.0, 16.0)})
    with pytest.raises(ValueError, match="the deformation"):
        Trainer(scene(finer), data, finer).load_state_dict(state)
    with pytest.raises(ValueError, match="the heads of components differ"):
        Trainer(scene(PLAIN, components=[SCREW]), data, PLAIN).load_state_dict(state)


def test_a_pose_keeps_its_precision_and_a_bare_scene_its_own_parts() -> None:
    full = scene(PLAIN, components=[SCREW])
    (assembly,) = full.assemblies
    pose = assembly.implant_to_world.clone()
    bare = full.without_components(assembly)
    assert full.float().assemblies[0].implant_to_world.dtype == torch.float64
    assert torch.equal(assembly.implant_to_world, pose)
    assert len(bare.assemblies[0].components) == 0 and len(assembly.components) == 1
    assert bare.materials == full.materials
    assert bare.assemblies[0].deformation is assembly.deformation


def test_no_points_are_displaced_by_nothing() -> None:
    deformation = scene(PLAIN).assemblies[0].deformation
    assert deformation.displacement(torch.zeros(0, 3)).shape == (0, 3)

"""A plate that was found one hole too far goes back."""

import pytest
import torch
from small_scene import GRID_OF_SCREWS, drilled_plate, image

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import RegistrationConfig, Stage, build_scene
from torchkcreg.registration.objective import StageObjective
from torchkcreg.registration.slide import slid

CONFIG = RegistrationConfig(stages=(Stage(oversampling=1, margin_mm=None),), **GRID_OF_SCREWS)


def objective_at(shift_mm: float) -> StageObjective:
    cloud = ImplantPointCloud.from_mesh(drilled_plate(), 0.5)
    pose = torch.eye(4, dtype=torch.float64)
    data = image(build_scene(cloud, CONFIG), CONFIG)
    pose[2, 3] = shift_mm
    scene = build_scene(cloud, CONFIG, implant_to_world=pose)
    return StageObjective(scene, data, CONFIG.stages[0], CONFIG)


def test_a_plate_one_hole_off_slides_back() -> None:
    objective = objective_at(16.0)
    found = slid(objective, objective.model.at_rest[0])
    assert found is not None
    moved = objective.model.world_points(found[None])[0] - objective.model.world_points(objective.model.at_rest)[0]
    assert float(moved[0, :, 2].mean()) == pytest.approx(-16.0, abs=0.01)
    assert float(moved[0, :, :2].abs().max()) < 0.01


def test_a_plate_in_its_place_stays() -> None:
    objective = objective_at(0.0)
    assert slid(objective, objective.model.at_rest[0]) is None


def test_only_a_stage_of_one_group_can_slide() -> None:
    with pytest.raises(ValueError, match="one group can slide"):
        Stage(groups=2, slide=True)

"""Where else a plate may be: one hole further, or where it started."""

import pytest
import torch
from small_scene import GRID_OF_SCREWS, drilled_plate, image, objective

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import Objective, RegistrationConfig, Stage, Trainer, build_scene
from torchkcreg.registration.steps import places

CONFIG = RegistrationConfig(start="given", stages=(Stage(oversampling=1, margin_mm=None),), **GRID_OF_SCREWS)


def objective_at(shift_mm: float) -> Objective:
    cloud = ImplantPointCloud.from_mesh(drilled_plate(), 0.5)
    pose = torch.eye(4, dtype=torch.float64)
    data = image(build_scene(cloud, CONFIG))
    pose[2, 3] = shift_mm
    scene = build_scene(cloud, CONFIG, implant_to_world=pose)
    return objective(scene, data, CONFIG.stages[0], CONFIG)


def test_a_plate_one_hole_off_is_tried_one_hole_back() -> None:
    there = objective_at(16.0)
    stayed, other, *_ = places(there, there.at_rest[0])
    assert (stayed == 0).all()
    rest, other_place = (there.moves.state(p).placements[0].nodes for p in (there.at_rest, other[None]))
    moved = other_place - rest
    assert float(moved[0, :, 2].mean()) == pytest.approx(-16.0, abs=0.01)
    assert float(moved[0, :, :2].abs().max()) < 0.01


def test_a_plate_in_its_place_is_tried_nowhere_else() -> None:
    there = objective_at(0.0)
    assert len(places(there, there.at_rest[0])) == 1


def test_the_start_is_tried_where_the_stage_left_it() -> None:
    there = objective_at(0.0)
    found = torch.zeros(6, dtype=torch.float64)
    found[3:] = 9.0
    assert any((place == 0).all() for place in places(there, found))


def test_a_registration_that_starts_one_hole_off_ends_in_its_place_and_tells_the_rival() -> None:
    stages = (Stage(oversampling=1, margin_mm=None, after=("slide",)), Stage(oversampling=1, margin_mm=None))
    cloud = ImplantPointCloud.from_mesh(drilled_plate(), 0.5)
    data = image(build_scene(cloud, CONFIG))
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 16.0
    trainer = Trainer(
        build_scene(cloud, CONFIG, implant_to_world=pose), data, CONFIG.model_copy(update={"stages": stages})
    )
    result = trainer.fit()
    assert float(result.implant_to_world[:3, 3].norm()) < 0.1
    assert result.diagnostics["rival"]["distance_mm"] == pytest.approx(16.0, abs=2.0)
    assert result.diagnostics["rival"]["misfit"] > result.diagnostics["rival"]["best_misfit"]


def test_only_a_stage_of_one_group_can_slide() -> None:
    with pytest.raises(ValueError, match="one group can slide"):
        Stage(groups=2, after=("slide",))

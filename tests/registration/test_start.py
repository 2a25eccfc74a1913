"""Start of a registration: kept where it agrees with the images, searched where it does not, twins named."""

from __future__ import annotations

import pytest
import torch
import trimesh
from small_scene import PLAIN, RIGID, geometry, image, plate, pose, scene

from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import Implant, RegistrationConfig, RegistrationData, Trainer, build_scene
from torchkcreg.registration.start import find_start

FAR = rigid_matrix(torch.tensor([2.0, -1.0, 0.7]).double(), torch.tensor([120.0, 40.0, -90.0]).double())


def never(*_: object) -> float:
    raise AssertionError("no trial is needed")


def with_start(start: str) -> RegistrationConfig:
    return PLAIN.model_copy(update={"start": start})


def distance(one: torch.Tensor, other: torch.Tensor) -> float:
    nodes = plate().coarsened_to(2.0).points.double()
    moved = transform_points(one, nodes) - transform_points(other, nodes)
    return float(moved.square().sum(-1).mean().sqrt())


def test_a_start_that_agrees_is_kept() -> None:
    data, near = image(scene(PLAIN, pose(3.0, 3.0))), scene(PLAIN)
    assert find_start(near, data, PLAIN, never).names == ()
    torch.testing.assert_close(near.assemblies[0].implant_to_world, torch.eye(4).double())


def test_a_given_start_is_never_searched() -> None:
    lost = scene(PLAIN, FAR)
    found = find_start(lost, image(scene(PLAIN)), with_start("given"), never)
    assert found.names == () and found.rival is None
    torch.testing.assert_close(lost.assemblies[0].implant_to_world, FAR)


@pytest.mark.parametrize("start", ["auto", "search"])
def test_an_implant_in_a_frame_of_its_own_is_registered(start: str) -> None:
    truth, config = pose(5.0, 30.0), with_start(start)
    trainer = Trainer(scene(config, FAR), image(scene(PLAIN, truth)), config)
    result = trainer.fit()
    assert trainer.searched == ("implant",)
    assert distance(result.implant_to_world, truth) < 0.1
    assert result.status == "ok", result.warnings


def test_a_twin_is_named_with_its_pose() -> None:
    """A plain box looks the same after half a turn."""
    box = ImplantPointCloud.from_mesh(trimesh.creation.box((12.0, 4.0, 50.0)), 0.5)
    config = RegistrationConfig(stages=RIGID, start="search")
    result = Trainer(build_scene(box, config), image(build_scene(box, PLAIN)), config).fit()
    assert result.status == "doubtful"
    assert any("fits nearly as well" in reason for reason in result.warnings)
    twin = torch.tensor(result.diagnostics["rival"]["pose"]).double()
    turn = twin[:3, :3] @ result.implant_to_world[:3, :3].T
    assert float(turn.trace()) == pytest.approx(-1.0, abs=0.02)


def test_only_the_implant_that_is_lost_is_searched() -> None:
    other = ImplantPointCloud.from_mesh(trimesh.creation.box((14.0, 14.0, 20.0)), 0.5)
    truths = [pose(1.0, 2.0), rigid_matrix(torch.tensor([0.4, 0.0, 0.2]).double(), torch.tensor([30.0, 0, 5]).double())]

    def both(first: torch.Tensor, second: torch.Tensor):
        implants = [Implant(plate(), implant_to_world=first, name="plate")]
        return build_scene([*implants, Implant(other, implant_to_world=second, name="block")], PLAIN)

    data = image(both(*truths))
    lost = both(FAR, truths[1])
    found = find_start(lost, data, PLAIN, lambda of, seen: 1.0)
    assert found.names == ("plate",)
    torch.testing.assert_close(lost.assemblies[1].implant_to_world, truths[1])
    assert distance(lost.assemblies[0].implant_to_world, truths[0]) < 1.5


def test_images_without_the_implant_fail_wherever_it_is_searched() -> None:
    noise = torch.rand(3, 160, 96, generator=torch.Generator().manual_seed(0))
    config = with_start("search")
    result = Trainer(scene(config, FAR), RegistrationData(geometry(), noise), config).fit()
    assert result.status == "failed"


def test_a_checkpoint_is_continued_without_another_search(monkeypatch: pytest.MonkeyPatch) -> None:
    config = with_start("search")
    data = image(scene(PLAIN, pose(2.0, 5.0)))
    trainer = Trainer(scene(config, FAR), data, replace_stages(config, 1))
    trainer.run()
    state = trainer.state_dict()
    resumed = Trainer(scene(config, FAR), data, config)
    resumed.load_state_dict(state)
    monkeypatch.setattr("torchkcreg.registration.trainer.find_start", never)
    resumed.run()
    assert distance(resumed.scene.assemblies[0].implant_to_world, pose(2.0, 5.0)) < 0.1


def replace_stages(config: RegistrationConfig, number: int) -> RegistrationConfig:
    return config.model_copy(update={"stages": config.stages[:number]})


def test_a_rigid_implant_is_searched_and_has_error_bars() -> None:
    """Joint components and screws do not bend."""
    config = RegistrationConfig(deformation="rigid", find_screws=False, pitch_mm=0.5)
    assert all(stage.level.is_rigid for stage in config.schedule())
    truth = pose(4.0, 20.0)
    trainer = Trainer(scene(config, FAR), image(scene(PLAIN, truth)), config)
    result = trainer.fit()
    assert distance(result.implant_to_world, truth) < 0.05
    nodes = plate().points.double()
    assert float(result.implants[0].displacement(nodes).abs().max()) == 0.0
    assert 0 < result.diagnostics["node_std_mm"] < 0.1
    assert result.status == "ok", result.warnings

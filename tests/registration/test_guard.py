"""A stage that loses is undone, and no state that cannot be is handed on."""

import pytest
import torch
from small_scene import RIGID, bend, image, pose, scene

from torchkcreg.optimization import CMAES, GaussNewton
from torchkcreg.registration import RegistrationConfig, Terms, Trainer
from torchkcreg.registration.guard import Guard, implausible

CONFIG = RegistrationConfig(stages=RIGID)


@pytest.fixture(name="guarded")
def _guarded():
    here = scene(CONFIG)
    guard = Guard(here, image(here), CONFIG)
    guard.before(RIGID[-1])
    return here, guard


def test_a_stage_that_explains_less_of_the_images_is_undone(guarded) -> None:
    here, guard = guarded
    before = here.assemblies[0].implant_to_world.detach()
    here.assemblies[0].implant_to_world = pose(3.0, 2.0)
    reason = guard.after()
    assert reason is not None
    assert "unexplained" in reason
    assert (here.assemblies[0].implant_to_world == before).all()


def test_a_stage_that_explains_more_of_them_stands() -> None:
    images = image(scene(CONFIG))
    here = scene(CONFIG, pose(3.0, 2.0))
    guard = Guard(here, images, CONFIG)
    guard.before(RIGID[-1])
    here.assemblies[0].implant_to_world = torch.eye(4)
    assert guard.after() is None
    assert (here.assemblies[0].implant_to_world == torch.eye(4)).all()


def test_what_is_not_finite_is_undone(guarded) -> None:
    here, guard = guarded
    with torch.no_grad():
        here.assemblies[0].deformation.control_points[0] = torch.nan
    assert "finite" in guard.after()
    assert bool(torch.isfinite(here.assemblies[0].deformation.control_points).all())


def test_metal_does_not_stretch_and_implants_do_not_fly_away() -> None:
    here = scene(CONFIG)
    start = here.assemblies[0].implant_to_world.detach()
    assert implausible(here, [start]) is None
    bend(here, 0.02)
    assert implausible(here, [start]) is None
    away = torch.eye(4, dtype=torch.float64)
    away[0, 3] = 500.0
    here.assemblies[0].implant_to_world = away @ here.assemblies[0].implant_to_world
    assert "500 mm" in implausible(here, [start])
    here.assemblies[0].implant_to_world = start
    bend(here, 2.0)
    assert "strained" in implausible(here, [start])


def test_strain_of_a_rigid_motion_is_nothing_and_of_a_stretch_its_share() -> None:
    here = scene(CONFIG)
    assert here.assemblies[0].rms_strain() == pytest.approx(0.0, abs=1e-9)
    grid = here.assemblies[0].deformation.grid
    along = grid.frame[:3, :3].T @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    with torch.no_grad():
        stretch = 0.01 * (grid.positions() @ along)[..., None] * along
        here.assemblies[0].deformation.control_points.copy_(stretch)
    assert here.assemblies[0].rms_strain() == pytest.approx(0.01, rel=0.02)


def test_a_stage_that_is_put_far_above_the_last_ones_end_does_not_pull_the_result_along() -> None:
    images = image(scene(CONFIG))
    trainer = Trainer(scene(CONFIG, pose(1.0, 1.0)), images, CONFIG)

    class Astray(GaussNewton):
        def best(self) -> torch.Tensor:
            found = super().best().clone()
            if trainer.next_stage == 2:
                found[3] += 5.0
            return found

    trainer.terms = Terms(optimizer=lambda *of: (CMAES if trainer.next_stage == 0 else Astray)(*of))
    result = trainer.fit()
    assert list(trainer.undone) == ["3"]
    assert float((result.implant_to_world[:3, 3]).norm()) < 0.1

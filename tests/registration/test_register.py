"""Whole registrations of small scenes: accuracy, resuming, background, bad input."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from pydantic import ValidationError
from small_scene import GRID, PLAIN, RIGID, SCREW, bend, geometry, image, plate, pose, scene

from torchkcreg.geometry import transform_points
from torchkcreg.registration import (
    Callback,
    Progress,
    RegisteredImplant,
    RegistrationConfig,
    RegistrationData,
    RegistrationResult,
    Stage,
    Trainer,
    preset_stages,
    register,
    with_background,
)

BENDING = RegistrationConfig(
    stages=(Stage(oversampling=1), Stage(groups=3, oversampling=1, tolerance=1e-4)), stiffness=1.0, beta=1e-7, **GRID
)


def test_a_rigid_motion_of_5_mm_and_5_degrees_is_recovered_within_20_micrometres() -> None:
    truth = pose(5, 5)
    result = register(plate(), image(scene(PLAIN, truth)), PLAIN)
    points = plate().points.double()
    error = (result.warp(points) - transform_points(truth, points)).norm(dim=-1)
    assert float(error.square().mean().sqrt()) < 0.02
    assert float(result.gc.min()) > 0.999


def test_bending_is_recovered() -> None:
    truth = scene(BENDING, pose(0.5, 0.5))
    bend(truth, 0.03)
    result = register(plate(), image(truth), BENDING)
    points = plate().points.double()
    expected = transform_points(truth.assemblies[0].implant_to_world, truth.assemblies[0].deformation(points))
    rest = scene(BENDING, pose(0.5, 0.5))
    start = (transform_points(rest.assemblies[0].implant_to_world, points) - expected).norm(dim=-1).max()
    error = (result.warp(points) - expected).norm(dim=-1)
    assert float(start.detach()) > 0.5
    assert float(error.square().mean().sqrt()) < 0.03


class _Stop(Callback):
    """Keeps a checkpoint of the first stage's end, or of an iteration of the last, and stops there."""

    def __init__(self, iteration: int | None) -> None:
        self.iteration, self.checkpoint = iteration, None

    def on_iteration(self, trainer: Trainer, index: int, progress: Progress) -> None:
        if (index, progress.iteration) == (2, self.iteration):
            self._keep(trainer)

    def on_stage_end(self, trainer: Trainer, index: int, stage: Stage) -> None:
        if index == 0 and self.iteration is None:
            self._keep(trainer)

    def _keep(self, trainer: Trainer) -> None:
        self.checkpoint = copy.deepcopy(trainer.state_dict())
        raise InterruptedError


@pytest.mark.parametrize("iteration", [None, 2])
def test_a_resumed_registration_ends_with_the_same_bits(iteration: int | None) -> None:
    short = {"oversampling": 1, "iterations": 3, "tolerance": 1e-9, "before": ("background", "reweight")}
    config = PLAIN.model_copy(update={"stages": (RIGID[0], Stage(**short), Stage(groups=2, **short))})
    data = image(scene(config, pose(2, 2)))
    whole = Trainer(scene(config), data, config).fit()
    stop = _Stop(iteration)
    with pytest.raises(InterruptedError):
        Trainer(scene(config), data, config, callbacks=[stop]).fit()
    resumed = Trainer(scene(config), data, config)
    resumed.load_state_dict(stop.checkpoint)
    again = resumed.fit()
    assert torch.equal(again.implant_to_world, whole.implant_to_world)
    assert torch.equal(again.deformation.control_points, whole.deformation.control_points)
    assert [r["loss"] for r in again.history] == [r["loss"] for r in whole.history]
    assert [s["loss"] for s in again.stages] == [s["loss"] for s in whole.stages]


def test_a_checkpoint_of_another_grid_is_refused() -> None:
    data = image(scene(PLAIN))
    other = PLAIN.model_copy(update={"grid_shape": (4, 4, 12)})
    state = Trainer(scene(other), data, other).state_dict()
    with pytest.raises(ValueError, match="the deformation differ"):
        Trainer(scene(PLAIN), data, PLAIN).load_state_dict(state)


def test_the_background_behind_the_implant_is_that_around_it() -> None:
    physics = {"material": "steel", "scatter": 0.05, "background_material": "cortical_bone", "background_mm": 4.0}
    config = PLAIN.model_copy(update=physics)
    here = scene(config, components=[SCREW])
    bone = torch.full((3, 160, 96), 20.0)
    modelled = image(here, background=bone)
    # the open beam of a measurement holds no scatter, the model's line integrals count from one that does
    data = RegistrationData(modelled.geometry, modelled.line_integrals - math.log(1.05))
    estimate = with_background(here, data, config.background_mm).background
    torch.testing.assert_close(estimate, bone, atol=1.0, rtol=0)


def test_a_background_is_sane_where_nothing_was_measured() -> None:
    config = PLAIN.model_copy(update={"material": "steel", "background_mm": 2.5})
    data = image(scene(config))
    mask = torch.zeros_like(data.line_integrals, dtype=torch.bool)
    mask[:, 70:90, 40:56] = True  # the open beam around it saturates
    dark = RegistrationData(data.geometry, torch.zeros_like(data.line_integrals), mask)
    estimate = with_background(scene(config), dark, config.background_mm).background
    assert bool(torch.isfinite(estimate).all())
    assert not estimate[:, :40].any()
    assert float(estimate.abs().max()) < 2001


def test_the_scatter_floor_is_estimated() -> None:
    config = RegistrationConfig(
        material="steel", scatter=0.1, prior_weight=0.0, stages=(Stage(estimate=("scatter",), tolerance=1e-4),), **GRID
    )
    data = image(scene(config, pose(0.2, 0.2)))
    even = torch.ones_like(data.line_integrals)
    data = replace(data, scatter_shapes=torch.stack([even, 0 * even]))
    guess = config.model_copy(update={"scatter": 0.03})
    result = register(plate(), data, guess)
    assert result.intensity["scatter"] == pytest.approx(0.1, abs=0.005)


def test_masked_pixels_do_not_matter_even_when_they_are_not_numbers() -> None:
    data = image(scene(PLAIN, pose(1, 1)))
    broken = data.line_integrals.clone()
    broken[:, 70:74, 40:44] = float("nan")
    hole = RegistrationData(data.geometry, broken)
    assert int((~hole.mask).sum()) == 3 * 16
    result = register(plate(), hole, PLAIN)
    points = plate().points.double()
    error = (result.warp(points) - transform_points(pose(1, 1), points)).norm(dim=-1)
    assert float(error.max()) < 0.05


def test_a_window_sees_what_the_whole_detector_sees() -> None:
    data = image(scene(PLAIN))
    points = plate().points
    window = data.windowed(points, 10)
    uv, _ = data.geometry.project(points[:5].double())
    inside, _ = window.geometry.project(points[:5].double())
    for view in range(3):
        offset = (uv - inside)[view, 0].round().long()
        u, v = inside[view, 0].round().long().tolist()
        assert window.line_integrals[view, v, u] == data.line_integrals[view, v + offset[1], u + offset[0]]
    torch.testing.assert_close((uv - inside).std(dim=1), torch.zeros(3, 2, dtype=uv.dtype), atol=1e-9, rtol=0)


def test_data_that_do_not_fit_are_refused() -> None:
    views = geometry()
    with pytest.raises(ValueError, match="3 views, the projections have 2"):
        RegistrationData(views, torch.zeros(2, 160, 96))
    with pytest.raises(ValueError, match="detector"):
        RegistrationData(views, torch.zeros(3, 96, 160))
    empty = torch.ones(3, 160, 96, dtype=torch.bool)
    empty[1] = False
    with pytest.raises(ValueError, match="view 1"):
        RegistrationData(views, torch.zeros(3, 160, 96), empty)
    far = RegistrationData(views, torch.zeros(3, 160, 96))
    with pytest.raises(ValueError, match="outside every view"):
        given = PLAIN.model_copy(update={"start": "given"})
        Trainer(scene(given, pose(300, 0)), far, given).check()


def test_unknown_options_are_refused_and_presets_split_groups() -> None:
    with pytest.raises(ValidationError):
        RegistrationConfig(gruops=3)
    with pytest.raises(ValidationError, match="groups only split"):
        RegistrationConfig(stages=(Stage(groups=4), Stage(groups=2)))
    for preset in ("gauss-newton", "paper", "adam"):
        stages = preset_stages(preset)
        assert stages[0].groups == 1 and stages[-1].groups >= 10


def test_a_result_warps_points_and_flags_those_outside_the_grid() -> None:
    here = scene(PLAIN, pose(1, 2))
    result = RegistrationResult([RegisteredImplant.of(here.assemblies[0])], torch.ones(3), [], PLAIN)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 500.0]])
    torch.testing.assert_close(result.warp(points), transform_points(pose(1, 2), points.double()))
    assert result.outside(points).tolist() == [False, True]


def test_a_registration_needs_no_gradients_from_around_it() -> None:
    truth = pose(2, 2)
    with torch.no_grad():
        result = register(plate(), image(scene(PLAIN, truth)), PLAIN)
    points = plate().points.double()
    assert float((result.warp(points) - transform_points(truth, points)).norm(dim=-1).max()) < 0.05

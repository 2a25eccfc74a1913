"""Views that stood otherwise than the geometry has it: the images ask for it, and what was found is given back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_scene import RIGID, image, plate, scene

from torchkcreg.io import RunFolder, read_run
from torchkcreg.registration import RegistrationConfig, RegistrationResult, Stage, register
from torchkcreg.registration.stage import StageRun
from torchkcreg.scene import RegistrationData, ViewMotions, ViewMotionSteps
from torchkcreg.similarity import GradientDifference

ALIGNED = Stage(oversampling=1, tolerance=1e-4, estimate=("views",), before=("align",))
CONFIG = RegistrationConfig(stages=(*RIGID, ALIGNED))
MOVED = 0.15 * torch.tensor(
    [[0.0, 1.0, -1.0, 1.0, 0.5, -1.0], [0.5, -1.0, 1.0, -2.0, 0.0, 1.0], [-0.5, 0.0, 0.0, 1.0, -0.5, 0.0]]
)  # what all have in common is none


def moved(data: RegistrationData) -> tuple[RegistrationData, ViewMotions]:
    """The same images, with the geometry of views that stood elsewhere."""
    motions = ViewMotions(plate().points, data.num_views, 0.2)
    motions.values.copy_(MOVED)
    off = data.geometry.moved(torch.linalg.inv(motions.matrices()))
    return replace(data, geometry=off), motions


@pytest.fixture(scope="module")
def data() -> RegistrationData:
    return image(scene(CONFIG))


@pytest.fixture(autouse=True, scope="module")
def coarse():
    """Coarse pixels tell less of a motion than a scan's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchkcreg.registration.steps._LEAST_STRENGTH", 10.0)
        yield


@pytest.fixture(scope="module")
def found(data) -> tuple[RegistrationResult, RegistrationData, ViewMotions]:
    off, motions = moved(data)
    return register(plate(), off, CONFIG), off, motions


def test_a_geometry_that_is_right_stays_as_it_is(data) -> None:
    result = register(plate(), data, CONFIG)
    assert result.view_motions is None and result.diagnostics["view_motion_mm"] is None
    assert result.corrected(data.geometry) is data.geometry


def test_views_that_moved_are_found_where_the_images_ask(found, data) -> None:
    result, off, motions = found
    nodes = plate().points[::20].double()
    true, told = (g.project(nodes)[0] for g in (data.geometry, off.geometry))
    seen = result.corrected(off.geometry).project(result.warp(nodes))[0]  # with the pose that goes with it
    before, after = ((uv - true).norm(dim=-1).mean() for uv in (told, seen))
    assert before > 0.2 and after < 0.3 * before  # pixels; without any, they all stay
    assert 0.1 < result.diagnostics["view_motion_mm"] < 0.6
    assert float(motions.values.sum(0).abs().max()) < 1e-6


def test_the_implant_is_nearer_to_its_shape_than_without(found) -> None:
    result, off, _ = found
    bare = register(plate(), off, CONFIG.model_copy(update={"view_motion": "off"}))
    assert bare.view_motions is None
    assert result.diagnostics["misfit"] < 0.5 * bare.diagnostics["misfit"]


def test_a_run_folder_keeps_the_motions(found, tmp_path) -> None:
    result = found[0]
    RunFolder.create(tmp_path / "run").write_result(result, [plate().points])
    torch.testing.assert_close(read_run(tmp_path / "run").view_motions, result.view_motions)


def test_steps_add_to_motions_and_are_charged_by_their_prior() -> None:
    motions = ViewMotions(plate().points, 3, 0.2)
    motions.values.copy_(MOVED)
    steps, step = ViewMotionSteps(motions), 0.1 * torch.randn(18, generator=torch.Generator().manual_seed(2)).double()
    expected = torch.linalg.inv(motions.matrices()) @ motions.matrices(motions.values + step.unflatten(0, (3, 6)))
    torch.testing.assert_close(steps.motions(step[None])[0], expected)
    torch.testing.assert_close(steps.motions(torch.zeros(1, 18).double())[0], torch.eye(4).double().expand(3, 4, 4))
    steps.weigh(2.0)
    penalty = float(steps.penalty(step[None])[0])
    assert penalty == pytest.approx(steps.loss_of_deviation * float(((MOVED.flatten() + step) / 0.2).square().sum()))
    steps.accept(step)
    torch.testing.assert_close(motions.values, MOVED.double() + step.unflatten(0, (3, 6)))


def test_a_scene_goes_back_to_what_it_kept(data) -> None:
    here = scene(CONFIG)
    before = here.kept()
    here.view_motions = moved(data)[1]
    after = here.kept()
    here.restore(before)
    assert here.view_motions is None
    here.restore(after)
    torch.testing.assert_close(here.view_motions.values, MOVED.double())
    assert here.float().view_motions.values.dtype == torch.float64


def test_one_view_alone_is_at_odds_with_none(data) -> None:
    config = CONFIG.model_copy(update={"view_motion": "on"})
    assert register(plate(), data.select([1]), config).view_motions is None


def test_a_similarity_of_ones_own_need_be_no_sum_of_squares(data) -> None:
    class Similarity:
        def __init__(self, fixed, mask, weights=None) -> None:
            self.whole = GradientDifference(fixed, mask)

        def __call__(self, images):
            return self.whole(images)

    stage = ALIGNED.model_copy(update={"optimizer": "adam", "iterations": 2})
    config = CONFIG.model_copy(update={"stages": (stage,)})
    result = register(plate(), moved(data)[0], config, similarity=Similarity)
    assert result.view_motions is not None


def test_motions_of_other_views_are_refused(data) -> None:
    here = scene(CONFIG)
    here.view_motions = moved(data)[1]
    with pytest.raises(ValueError, match="motions of 3 views do not fit a geometry of 2"):
        here.view(data.select([0, 1]))
    assert here(data.geometry.select([0, 1])).shape[0] == 2  # a geometry alone is taken as it is


def test_derivatives_to_the_views_are_taken_of_all_views_at_once(data) -> None:
    off, motions = moved(data)
    here = scene(CONFIG)
    here.view_motions = motions
    run = StageRun(here, off, ALIGNED, CONFIG)
    at = 0.02 * torch.randn(run.objective.num_parameters, generator=torch.Generator().manual_seed(0)).double()
    at[: run.objective.moves.places["views"].start] = 0
    jacobian, residuals = run.objective.jacobian(at)
    places = run.objective.moves.places["views"]
    assert places.stop - places.start == 6 * off.num_views
    for number in (places.start, places.start + 8, places.stop - 1, 0):
        step = torch.zeros_like(at)
        step[number] = 0.01
        slope = (run.objective._residuals((at + step)[None])[0] - residuals) / 0.01
        torch.testing.assert_close(jacobian[number], slope, atol=2e-2 * float(slope.abs().max()), rtol=0)

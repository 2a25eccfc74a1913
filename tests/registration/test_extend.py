"""Pieces of one's own: deformation, similarity, optimiser, penalty, step; and several implants."""

from __future__ import annotations

import pytest
import torch
from small_scene import RIGID, SCREW, bend, geometry, image, plate, pose, scene

from torchkcreg.deformation import LinearDeformation, RigidDeformation
from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, transform_points
from torchkcreg.reconstruction import PWLSConfig, reconstruct
from torchkcreg.registration import (
    Callback,
    Implant,
    Optimizer,
    RegistrationConfig,
    RegistrationResult,
    Stage,
    StageRun,
    Trainer,
    build_scene,
    register,
)
from torchkcreg.scene import State
from torchkcreg.similarity import Similarity, gradient_correlation, normalized_cross_correlation

GRID = {"grid_shape": (4, 4, 6), "grid_spacing_mm": (10.0, 10.0, 12.0)}
RIGIDLY = RegistrationConfig(stages=RIGID, **GRID)
BENDING = RegistrationConfig(
    stages=(Stage(oversampling=1), Stage(groups=2, oversampling=1, tolerance=1e-4)), stiffness=1.0, beta=1e-7, **GRID
)


class Hinge(LinearDeformation):
    """A plate whose upper third turns about an axis across it, as a mechanic would have it."""

    model = "hinge"

    def __init__(self, implant, config) -> None:
        super().__init__(2)
        self.height = float(implant.cloud.points[:, 2].quantile(2 / 3))

    def shapes(self, points):
        x, y, z = points.unbind(-1)
        above = (z - self.height).clamp_min(0)
        still, turns = torch.zeros_like(z), (above > 0).to(z)
        forward = torch.stack([still, above, -y * turns], dim=-1)
        sideways = torch.stack([above, still, -x * turns], dim=-1)
        return 0.1 * torch.stack([forward, sideways], dim=-2)

    def prior(self, amounts):
        return 1e-6 * amounts.square().sum(-1)


def test_a_deformation_of_ones_own_is_registered() -> None:
    truth = build_scene(plate(), BENDING, deformation=Hinge, implant_to_world=pose(0.5, 0.5))
    with torch.no_grad():
        truth.assemblies[0].deformation.amounts.copy_(torch.tensor([0.3, -0.15]))
    result = register(plate(), image(truth), BENDING, deformation=Hinge)
    points = plate().points.double()
    error = (result.warp(points) - truth.assemblies[0].warp(points)).norm(dim=-1)
    assert float(error.max()) < 0.02
    assert result.deformation.amounts.tolist() == pytest.approx([0.3, -0.15], abs=0.01)
    assert result.diagnostics["node_std_mm"] < 0.15


def test_one_without_any_bending_only_moves() -> None:
    truth = pose(2, 2)
    result = register(
        plate(), image(scene(BENDING, truth)), BENDING, deformation=lambda implant, config: RigidDeformation()
    )
    points = plate().points.double()
    torch.testing.assert_close(result.warp(points), transform_points(truth, points), atol=0.02, rtol=0)
    assert result.deformation.model == "rigid"


class Correlation(Similarity):
    """Normalised cross-correlation of the images themselves."""

    def __init__(self, fixed, mask, weights=None) -> None:
        super().__init__()
        self.fixed, self.mask = fixed, mask

    def forward(self, moving):
        return normalized_cross_correlation(moving, self.fixed, mask=self.mask)


def test_a_similarity_of_ones_own_is_used() -> None:
    data = image(scene(RIGIDLY, pose(1, 1)))
    adam = Stage(bin=2, oversampling=1, optimizer="adam", iterations=150, step_mm=0.1)
    config = RIGIDLY.model_copy(update={"stages": (adam,)})
    result = register(plate(), data, config, similarity=Correlation)
    points = plate().points.double()
    error = (result.warp(points) - transform_points(pose(1, 1), points)).norm(dim=-1)
    assert float(error.max()) < 0.2


def test_a_similarity_that_is_no_sum_of_squares_is_refused_by_gauss_newton_by_name() -> None:
    data = image(scene(RIGIDLY))
    config = RIGIDLY.model_copy(update={"stages": (Stage(),)})
    with pytest.raises(NotImplementedError, match="Correlation is not a sum of squares"):
        register(plate(), data, config, similarity=Correlation)


class Compass(Optimizer):
    """Tries a step ahead and back along each parameter, and halves the steps when none is better."""

    def __init__(self, problem, stage, seed) -> None:
        super().__init__(problem, stage, seed)
        self.here, self.loss, self.step = self._zeros(), float("inf"), stage.step_mm

    def ask(self):
        steps = self.step * torch.eye(len(self.here)).to(self.here)
        return self.problem.project(torch.cat([self.here[None], self.here + steps, self.here - steps]))

    def tell(self, candidates, losses) -> None:
        best = int(losses.argmin())
        self.here, self.loss = candidates[best], float(losses[best])
        self.step *= 1.0 if best else 0.5
        self._advance(self.loss, self.step, end=self.step < self.stage.tolerance)

    def best(self):
        return self.here

    def state_dict(self):
        return {"here": self.here, "step": self.step, **self._ended()}

    def load_state_dict(self, state) -> None:
        self.here, self.step = state["here"], state["step"]
        self._end_as(state)


def test_an_optimizer_of_ones_own_is_used() -> None:
    data = image(scene(RIGIDLY, pose(1, 1)))
    stage = Stage(bin=2, oversampling=1, optimizer="compass", iterations=200, tolerance=0.01, step_mm=0.5)
    config = RIGIDLY.model_copy(update={"stages": (stage,)})
    result = register(plate(), data, config, optimizer=Compass)
    points = plate().points.double()
    assert float((result.warp(points) - transform_points(pose(1, 1), points)).norm(dim=-1).max()) < 0.25
    assert result.stages[0]["converged"]
    with pytest.raises(ValueError, match="optimizer must be one of gauss-newton, cmaes, adam, got 'compass'"):
        register(plate(), data, config)


def test_a_penalty_of_ones_own_holds_the_implant_back() -> None:
    data = image(scene(RIGIDLY, pose(3, 0)))
    config = RIGIDLY.model_copy(update={"stages": RIGID[1:]})
    start = plate().points.double().mean(0)

    def stays(state: State) -> torch.Tensor:
        return 100.0 * (state.placements[0].nodes.double().mean(1) - start).square().sum(-1)

    free, held = (register(plate(), data, config, penalties=penalties) for penalties in ((), (stays,)))
    assert float((free.implant_to_world[:3, 3]).norm()) > 2.5
    assert float((held.warp(start[None]) - start).norm()) < 0.1


def test_a_step_of_ones_own_is_taken_and_an_unknown_one_refused() -> None:
    data, taken = image(scene(RIGIDLY)), []
    stage = Stage(bin=2, oversampling=1, iterations=1, before=("look",), after=("look",))
    config = RIGIDLY.model_copy(update={"stages": (stage,)})

    def look(run: StageRun) -> None:
        taken.append(float(gradient_correlation(run.scene(run.view()), run.view().images.line_integrals).mean()))

    register(plate(), data, config, steps={"look": look})
    assert len(taken) == 2 and min(taken) > 0.99
    with pytest.raises(ValueError, match="there is no step 'look': steps are align, background"):
        register(plate(), data, config)


def test_what_the_intensity_model_does_not_offer_cannot_be_estimated() -> None:
    config = RIGIDLY.model_copy(update={"material": "steel", "stages": (Stage(estimate=("colour",)),)})
    with pytest.raises(ValueError, match="'colour' cannot be estimated: blur, hardness, removed, scatter"):
        register(plate(), image(scene(RIGIDLY)), config)


def two_plates(apart: torch.Tensor, offset: torch.Tensor) -> list[Implant]:
    """A plate, and another one beside it, each off its place by a motion of its own."""
    beside = torch.eye(4, dtype=torch.float64)
    beside[:3, 3] = torch.tensor([22.0, 8.0, -6.0], dtype=torch.float64)
    return [Implant(plate(), implant_to_world=apart, name="medial"), Implant(plate(), implant_to_world=beside @ offset)]


def test_two_plates_are_registered_together_each_with_its_own_pose_and_bend() -> None:
    still, first, second = torch.eye(4, dtype=torch.float64), pose(0.8, 1.0), pose(-0.6, 0.7)
    truth = build_scene(two_plates(first, second), BENDING)
    bend_one = build_scene([two_plates(first, second)[0]], BENDING)
    bend(bend_one, 0.02)
    truth.assemblies[0].deformation.load_state_dict(bend_one.assemblies[0].deformation.state_dict())
    result = register(two_plates(still, still), image(truth), BENDING)
    points = plate().points.double()
    for assembly in truth.assemblies:
        error = (result.warp(points, implant=assembly.name) - assembly.warp(points)).norm(dim=-1)
        assert float(error.detach().square().mean().sqrt()) < 0.03, assembly.name
    assert [implant.name for implant in result.implants] == ["medial", "implant"]
    with pytest.raises(ValueError, match="no implant 'lateral': there are medial, implant"):
        result.warp(points, implant="lateral")


def test_implants_of_one_name_are_refused() -> None:
    still = torch.eye(4, dtype=torch.float64)
    twice = [two_plates(still, still)[0]] * 2
    with pytest.raises(ValueError, match="names of their own, got medial, medial"):
        build_scene(twice, BENDING)


class _StopsIn(Callback):
    def on_iteration(self, trainer, index, progress) -> None:
        if index == 1:
            trainer.stop("seen enough")


def test_a_registration_that_is_ended_early_says_so() -> None:
    data = image(scene(RIGIDLY, pose(1, 1)))
    trainer = Trainer(scene(RIGIDLY), data, RIGIDLY, callbacks=[_StopsIn()])
    result = trainer.fit()
    assert len(result.stages) == 2
    assert result.stages[1]["iterations"] == 1 and not result.stages[1]["converged"]
    assert result.status == "doubtful" and "seen enough" in result.warnings[-1]
    hurried = register(plate(), data, RIGIDLY, seconds=0.0)
    assert len(hurried.history) == 1 and "its time was up" in hurried.warnings[-1]


def test_a_registration_starts_from_another_ones_end() -> None:
    data = image(scene(RIGIDLY, pose(6, 6)))
    first = register(plate(), data, RIGIDLY)
    config = RIGIDLY.model_copy(update={"stages": (Stage(bin=2, oversampling=1, iterations=2),)})
    again = register(plate(), data, config, start=first)
    points = plate().points.double()
    assert float((again.warp(points) - first.warp(points)).norm(dim=-1).max()) < 0.25


def test_a_result_projects_itself_into_any_views_and_describes_itself() -> None:
    data = image(scene(RIGIDLY, pose(1, 1)))
    result = register(plate(), data, RIGIDLY)
    drr = result.project(data.geometry)
    assert float(gradient_correlation(drr, data.line_integrals).min()) > 0.999
    assert repr(result).startswith(f"RegistrationResult({result.status}: implant, gc 1.000 1.000 1.000, expected error")


def test_a_result_is_saved_with_its_scene_and_loaded(tmp_path) -> None:
    config = RIGIDLY.model_copy(update={"material": "steel", "stages": RIGID[1:2]})
    data = image(scene(config, pose(0.3, 0.3), components=[SCREW]))
    result = register(plate(), data, config, components=[SCREW])
    result.save(tmp_path / "result.pt")
    again = RegistrationResult.load(tmp_path / "result.pt")
    points = plate().points.double()
    torch.testing.assert_close(again.warp(points), result.warp(points), atol=1e-12, rtol=0)
    torch.testing.assert_close(again.project(geometry()), result.project(geometry()))
    assert repr(again) == repr(result) and again.history == result.history
    (tmp_path / "result.pt").write_bytes(b"no result")
    with pytest.raises(ValueError, match=r"result .* cannot be read"):
        RegistrationResult.load(tmp_path / "result.pt")
    result.scene = None
    with pytest.raises(ValueError, match="read from a run folder"):
        result.project(geometry())


def test_known_components_and_the_beam_come_from_the_result_in_memory() -> None:
    config = RIGIDLY.model_copy(update={"material": "titanium", "stages": RIGID[1:2]})
    result = register(plate(), image(scene(config, components=[SCREW])), config, components=[SCREW])
    bent, screw = result.known_components()
    assert (bent.material, screw.material) == ("titanium", "steel")
    assert bent.cloud.volume == pytest.approx(plate().volume) and screw.cloud.volume == pytest.approx(
        SCREW.cloud.volume
    )
    moved = transform_points(result.implants[0].motion_of(SCREW.as_screw), SCREW.head[None].double())
    torch.testing.assert_close(moved, result.warp(SCREW.head[None]), atol=0.02, rtol=0)
    beam = result.beam()
    assert float(beam.weights.sum()) == pytest.approx(1.0) and beam.attenuation.shape[0] == 2
    data = image(scene(config, components=[SCREW]))
    scatter = result.scatter(torch.exp(-data.line_integrals), data.geometry)
    assert scatter.shape == data.line_integrals.shape
    assert 0 < float(scatter.mean()) <= result.intensity["scatter"]
    transmission = torch.exp(-data.line_integrals)
    found = result.known(transmission, data.geometry)
    assert [part.material for part in found["components"]] == ["titanium", "steel"]
    spacing = data.geometry.pixel_spacing[0]
    assert found["blur_sigma_px"] == pytest.approx(result.intensity["blur_sigma_px"]) and found["blur_sigma_px"] > 0
    halved = result.known(
        transmission, ConeBeamGeometry(data.geometry.projection_matrices, data.geometry.det_shape, (2 * spacing,) * 2)
    )
    assert halved["blur_sigma_px"] == pytest.approx(found["blur_sigma_px"] / 2)  # pixels are larger
    again = RegistrationResult.from_dict(result.to_dict())
    assert again.blur_mm == pytest.approx(result.intensity["blur_sigma_px"] * spacing)
    grid = VolumeGrid.centered((10, 6, 6), 2.0)
    done = reconstruct(transmission, data.geometry, grid, config=PWLSConfig(iterations=1, subsets=1), passes=1, **found)
    assert done.volume.isfinite().all() and done.mask is not None and float(done.mask.min()) < 0.5
    plain = register(plate(), image(scene(RIGIDLY)), RIGIDLY.model_copy(update={"stages": RIGID[1:2]}))
    with pytest.raises(ValueError, match="registered without a material"):
        plain.known_components()
    with pytest.raises(ValueError, match="had no beam"):
        plain.beam()

"""Group motions, stage model and objective: increments, gradients, curvature, equivariance."""

from __future__ import annotations

import pytest
import torch
from small_scene import SCREW, bend, geometry, image, objective, pose, scene

from torchkcreg.geometry import transform_points
from torchkcreg.optimization import Optimizer, iterate
from torchkcreg.registration import OPTIMIZERS, Objective, RegistrationConfig, Stage

PLAIN = RegistrationConfig(grid_shape=(4, 4, 6), grid_spacing_mm=(10.0, 10.0, 12.0))
STEEL = PLAIN.model_copy(update={"material": "steel"})


def _zeros(of: Objective) -> torch.Tensor:
    return of.at_rest[0]


def _world_points(of: Objective, parameters: torch.Tensor | None = None) -> torch.Tensor:
    """World positions (K, N, 3) of the implant's nodes."""
    return of.moves.state(of.at_rest if parameters is None else parameters).placements[0].nodes


def test_a_zero_step_leaves_the_scene_where_it_is() -> None:
    here = scene(PLAIN, pose(2, 3))
    bend(here, 0.02)
    points = _world_points(objective(here, image(here), Stage(groups=3), PLAIN))[0].double()
    nodes = here.assemblies[0].implant.points.double()
    expected = transform_points(here.assemblies[0].implant_to_world, here.assemblies[0].deformation(nodes))
    torch.testing.assert_close(points, expected, atol=2e-4, rtol=0)


def test_a_finer_stage_starts_where_the_coarser_one_ended() -> None:
    here = scene(PLAIN, pose(1, 1))
    bend(here, 0.02)
    data = image(here)
    coarse, fine = (objective(here, data, Stage(groups=g, oversampling=1), PLAIN) for g in (3, 5))
    torch.testing.assert_close(fine.losses(_zeros(fine)[None]), coarse.losses(_zeros(coarse)[None]), atol=1e-5, rtol=0)


def test_an_accepted_step_is_what_the_objective_evaluated() -> None:
    here = scene(PLAIN)
    data = image(here)
    bending = objective(here, data, Stage(groups=2), PLAIN)
    step = 0.3 * torch.randn(bending.num_parameters, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = _world_points(bending, step[None])[0].double()
    bending.accept(step)
    nodes = here.assemblies[0].implant.points.double()
    moved = transform_points(here.assemblies[0].implant_to_world, here.assemblies[0].deformation(nodes))
    torch.testing.assert_close(moved, expected, atol=2e-4, rtol=0)


def test_a_unit_step_of_any_parameter_moves_the_implant_by_a_millimetre_or_less() -> None:
    here = scene(PLAIN)
    rigid = objective(here, image(here), Stage(groups=1), PLAIN)
    still, moved = _world_points(rigid), _world_points(rigid, torch.eye(6, dtype=torch.float64))
    size = (moved - still).square().sum(-1).mean(-1).sqrt()
    assert ((size > 0.1) & (size < 1.2)).all()


@pytest.mark.parametrize("config", [PLAIN, STEEL])
def test_the_gradient_is_that_of_the_loss(config: RegistrationConfig) -> None:
    truth = scene(config, pose(0.4, 0.5), components=[SCREW])
    data = image(truth)
    here = scene(config, components=[SCREW])
    fitted = objective(here, data, Stage(groups=2, estimate=("scatter", "blur")), config)
    at = _zeros(fitted)
    _, gradient = fitted.loss_and_gradient(at)
    direction = torch.nn.functional.normalize(gradient, dim=0)
    ahead, behind = fitted.losses(torch.stack([at + 0.01 * direction, at - 0.01 * direction]))
    assert float(ahead - behind) / 0.02 == pytest.approx(float(gradient @ direction), rel=0.02)


@pytest.mark.parametrize(("on_coarse_pixels", "within"), [(False, 0.1), (True, 0.4)])
def test_the_curvature_is_the_loss_s_second_derivative_at_the_optimum(on_coarse_pixels: bool, within: float) -> None:
    here = scene(PLAIN)
    rigid = objective(here, image(here), Stage(groups=1, oversampling=2), PLAIN)
    assert rigid.coarse is not None and rigid.coarse.view.pixel_px == 2 * rigid.view.pixel_px
    if not on_coarse_pixels:
        rigid.coarse = None
    curvature = rigid.curvature(_zeros(rigid))
    torch.testing.assert_close(curvature, curvature.T)
    assert (torch.linalg.eigvalsh(curvature) > 0).all()
    for direction in torch.eye(6, dtype=torch.float64):
        ahead, here_, behind = rigid.losses(torch.stack([0.05 * direction, 0 * direction, -0.05 * direction]))
        measured = float(ahead - 2 * here_ + behind) / 0.05**2
        assert measured == pytest.approx(float(direction @ curvature @ direction), rel=within)


def test_moving_the_implant_is_moving_the_gantry_back() -> None:
    motion = pose(3, 4)
    moved = image(scene(PLAIN, motion))
    views = geometry().moved(motion)
    with torch.no_grad():
        other = scene(PLAIN)(views)
    torch.testing.assert_close(other, moved.line_integrals, atol=2e-3, rtol=0)


def test_a_rigid_motion_costs_no_penalty_and_a_bend_does() -> None:
    here = scene(PLAIN)
    bending = objective(here, image(here), Stage(groups=2), PLAIN)
    rigid = objective(here, image(here), Stage(groups=1), PLAIN)
    assert float(rigid.penalty(torch.full((1, 6), 1.0, dtype=torch.float64))) < 1e-12
    bent = _zeros(bending)
    bent[0] = 0.5
    assert float(bending.penalty(bent[None])) > 1e-7


def test_a_component_follows_the_implant_near_its_head() -> None:
    here = scene(PLAIN, components=[SCREW])
    bend(here, 0.05)
    motion = here.assemblies[0].component_motions()["screw"]
    near = SCREW.head[None].double()
    torch.testing.assert_close(transform_points(motion, near), here.assemblies[0].deformation(near), atol=0.05, rtol=0)
    turn = torch.linalg.matrix_norm(motion[:3, :3] - torch.eye(3, dtype=torch.float64))
    assert 0.02 < float(turn.detach()) < 0.08


@pytest.mark.parametrize("optimizer", ["gauss-newton", "cmaes", "adam"])
def test_every_optimizer_finds_the_bottom_of_a_bowl(optimizer: str) -> None:
    class Bowl:
        num_parameters, device = 3, torch.device("cpu")
        target = torch.tensor([0.5, -0.2, 0.3], dtype=torch.float64)
        scale = torch.tensor([1.0, 4.0, 0.25], dtype=torch.float64)

        def losses(self, candidates: torch.Tensor) -> torch.Tensor:
            return (self.scale * (candidates - self.target) ** 2).sum(-1)

        def loss_and_gradient(self, at: torch.Tensor) -> tuple[float, torch.Tensor]:
            return float(self.losses(at[None])[0]), 2 * self.scale * (at - self.target)

        def curvature(self, at: torch.Tensor) -> torch.Tensor:
            return torch.diag(2 * self.scale)

        def project(self, candidates: torch.Tensor) -> torch.Tensor:
            return candidates

    step = {"gauss-newton": 1.0, "cmaes": 0.3, "adam": 0.05}[optimizer]
    stage = Stage(optimizer=optimizer, iterations=300, tolerance=1e-5, step_mm=step, population=12)
    walker, iterations = OPTIMIZERS[optimizer](Bowl(), stage, 3), 0
    while not walker.done:
        iterate(walker)
        iterations += 1
    torch.testing.assert_close(walker.best(), Bowl.target, atol=2e-3, rtol=0)
    assert walker.progress.iteration == iterations > 0


@pytest.mark.parametrize("optimizer", ["gauss-newton", "cmaes", "adam"])
def test_an_optimizer_goes_on_from_its_state_to_the_same_bits(optimizer: str) -> None:
    here = scene(PLAIN, pose(0.5, 0.5))
    data = image(scene(PLAIN))
    stage = Stage(bin=2, oversampling=1, optimizer=optimizer, iterations=6, population=6, step_mm=0.2, tolerance=1e-9)

    def after(iterations: int, walker: Optimizer) -> Optimizer:
        for _ in range(iterations):
            iterate(walker)
        return walker

    whole, half, again = (OPTIMIZERS[optimizer](objective(here, data, stage, PLAIN), stage, 3) for _ in range(3))
    again.load_state_dict(after(3, half).state_dict())
    assert again.progress == half.progress
    assert torch.equal(after(3, again).best(), after(6, whole).best())
    assert again.progress == whole.progress

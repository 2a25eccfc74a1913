import math
from typing import ClassVar

import pytest
import torch

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import MultisourceScanner, VolumeGrid, circular_geometry
from torchkcreg.reconstruction import PWLS, PWLSConfig, VoxelSystem, pwls, statistical_weights
from torchkcreg.reconstruction.system import VoxelRoughness

GRID = VolumeGrid.centered((6, 12, 12), 5.0)


@pytest.fixture(scope="module")
def problem():
    """A noisy scan of a dense ball with a denser core, its system and weights."""
    geometry = circular_geometry(range(0, 200, 5), sad=404, sdd=538, det_shape=(10, 20), pixel_spacing=(6.0, 6.0))
    system = VoxelSystem(geometry, GRID)
    distance = GRID.points().norm(dim=-1)
    truth = 0.02 * (distance < 24) + 0.1 * (distance < 7)
    exact = system.project(truth, range(40))
    noisy = torch.poisson(1e4 * torch.exp(-exact), generator=torch.Generator().manual_seed(0)) / 1e4
    return system, truth, -noisy.clamp_min(1e-4).log(), statistical_weights(noisy)


def solve(problem, config=None, **options):
    system, _, data, weights = problem
    return PWLS(system, data, weights, config, **options)


def test_momentum_reaches_the_plain_objective_in_a_tenth_of_the_iterations(problem):
    plain = solve(problem, PWLSConfig(iterations=200, subsets=8, momentum=False, beta=0.1))
    plain.run()
    fast = solve(problem, PWLSConfig(iterations=20, subsets=8, beta=0.1))
    fast.run()
    assert fast.objective() <= plain.objective() * (1 + 1e-3)


def test_the_minimum_has_no_gradient_where_the_volume_is_positive(problem):
    system, _, data, weights = problem
    solver = solve(problem, PWLSConfig(iterations=150, subsets=1, beta=2.0))
    volume = solver.run().volume
    views = range(40)
    slope = system.backproject(weights * (system.project(volume, views) - data), views)
    slope += 2.0 * VoxelRoughness(GRID.spacing).gradient(volume)
    start = system.backproject(weights * data, views).abs().max()
    assert slope[volume > 0].abs().max() < 1e-3 * start
    assert slope[volume == 0].min() > -1e-3 * start
    assert volume.min() >= 0


def test_the_objective_that_is_traced_is_the_one_of_the_volume(problem):
    system, _, data, weights = problem
    solver = solve(problem, PWLSConfig(iterations=2, subsets=4, beta=0.5, objective_every=1))
    record = solver.run().history[-1]
    residual = system.project(solver.volume, range(40)) - data
    differences = sum(float(solver.volume.diff(dim=dim).square().sum()) for dim in range(3))
    assert record["objective"] == pytest.approx(
        float(0.5 * (weights * residual**2).sum()) + 0.25 * differences, rel=1e-5
    )


def test_more_roughness_makes_the_volume_smoother(problem):
    rough, smooth = (
        solve(problem, PWLSConfig(iterations=10, subsets=4, beta=beta)).run().volume for beta in (0.0, 3000.0)
    )
    assert smooth.diff(dim=-1).abs().mean() < 0.5 * rough.diff(dim=-1).abs().mean()


def test_a_stopped_run_resumes_to_the_same_bits(problem):
    config = PWLSConfig(iterations=8, subsets=4)
    whole = solve(problem, config).run().volume
    first = solve(problem, config)
    for _ in range(3):
        first.step()
    second = solve(problem, config)
    second.load_state_dict(first.state_dict())
    result = second.run()
    assert torch.equal(result.volume, whole)
    assert [record["iteration"] for record in result.history] == list(range(1, 9))
    with pytest.raises(ValueError, match="another configuration"):
        solve(problem, PWLSConfig(iterations=9)).load_state_dict(first.state_dict())


def test_a_warm_start_saves_iterations(problem):
    config = PWLSConfig(iterations=2, subsets=4, objective_every=1)
    near = solve(problem, PWLSConfig(iterations=20, subsets=4)).run().volume
    cold = solve(problem, config).run().history[-1]["objective"]
    warm = solve(problem, config, initial=near).run().history[0]["objective"]
    assert warm < cold


def test_what_is_masked_sends_no_ray_and_is_filled_smoothly(problem):
    system, truth, _, weights = problem
    mask = (GRID.points().norm(dim=-1) > 10).float()
    data = system.project(truth * mask, range(40))
    volume = pwls(system, data, weights, PWLSConfig(iterations=30, subsets=4, beta=0.1), mask=mask).volume
    inside = (GRID.points().norm(dim=-1) < 18) & (mask == 0)
    assert volume[inside].mean() == pytest.approx(0.02, rel=0.1)


def test_callbacks_see_each_iteration(problem):
    class Notes(Callback):
        seen: ClassVar[list] = []

        def on_stage_start(self, run, index, stage):
            self.seen.append(stage.iterations)

        def on_iteration(self, run, index, progress):
            self.seen.append((index, progress["iteration"], run.iteration))

        def on_stage_end(self, run, index, stage):
            self.seen.append("end")

    solve(problem, PWLSConfig(iterations=2, subsets=2)).run(callbacks=[Notes()], number=4)
    assert Notes.seen == [2, (4, 1, 1), (4, 2, 2), "end"]


def test_presets_are_the_paper_and_a_tenth_of_it():
    paper, momentum = PWLSConfig.preset("paper"), PWLSConfig.preset("momentum")
    assert (paper.iterations, paper.subsets, paper.momentum) == (500, 20, False)
    assert momentum.iterations == 50 and momentum.momentum
    assert sum(stage.iterations for stage in momentum.stages()) == 50
    with pytest.raises(ValueError, match="preset must be one of"):
        PWLSConfig.preset("fast")


def test_a_user_brings_a_projector_of_their_own():
    class Sum:
        volume_shape, num_views, sources = (1, 1, 4), 2, None

        def project(self, volume, views):
            return volume.sum().expand(len(views), 1, 1)

        def backproject(self, images, views):
            return images.sum().expand(1, 1, 4)

    volume = pwls(Sum(), torch.full((2, 1, 1), 2.0), torch.ones(2, 1, 1), PWLSConfig(iterations=60, subsets=2)).volume
    assert torch.allclose(volume, torch.full((1, 1, 4), 0.5), atol=1e-3)


def test_what_does_not_fit_is_named(problem):
    system, _, data, weights = problem
    with pytest.raises(ValueError, match="line_integrals must have shape"):
        PWLS(system, data[:3], weights[:3])
    with pytest.raises(ValueError, match="weights must not be negative, and some must be above zero"):
        PWLS(system, data, torch.zeros_like(data))
    with pytest.raises(ValueError, match="line_integrals must be finite"):
        PWLS(system, data.clone().fill_(math.nan), weights)
    with pytest.raises(ValueError, match="mask must be between 0 and 1"):
        PWLS(system, data, weights, mask=torch.full(GRID.shape, 2.0))
    with pytest.raises(ValueError, match="subsets must be at most the number of views 40"):
        PWLS(system, data, weights, PWLSConfig(subsets=41))
    away = VoxelSystem(system.geometry, VolumeGrid.centered((3, 3, 3), 1.0, center=(0, 0, 900)))
    with pytest.raises(ValueError, match="outside the field of view"):
        PWLS(away, data, weights)


def test_weights_are_those_of_poisson_counts_behind_scatter():
    generator = torch.Generator().manual_seed(1)
    primary, scatter, photons = 0.2, 0.1, 1e4
    counts = torch.poisson(torch.full((200000,), (primary + scatter) * photons), generator=generator) / photons
    variance = float((counts - scatter).log().var())
    weight = float(statistical_weights(torch.tensor([primary]), scatter=scatter))
    assert 1 / (weight * photons) == pytest.approx(variance, rel=0.02)


def test_subsets_of_the_scanner_hold_all_focal_spots():
    geometry = MultisourceScanner(det_shape=(8, 8), det_size_mm=(298, 298)).geometry()
    assert VoxelSystem(geometry, GRID).sources == geometry.sources


def test_negative_values_are_kept_if_they_may_be(problem):
    signed = solve(problem, PWLSConfig(iterations=10, subsets=4, beta=0.1, nonnegative=False)).run().volume
    assert signed.min() < -1e-4
    assert solve(problem, PWLSConfig(iterations=10, subsets=4, beta=0.1)).run().volume.min() == 0.0


def test_the_estimate_of_a_plain_full_step_is_the_objective_before_it(problem):
    """With one subset the misfit is that before the step; the roughness is that after it, which is nearly the same."""
    solver = solve(problem, PWLSConfig(iterations=3, subsets=1, momentum=False, beta=3000.0, objective_every=1))
    history = solver.run().history
    roughness = 3000.0 * float(VoxelRoughness(GRID.spacing).value(solver.volume))
    assert roughness > 0.002 * history[-1]["estimate"]
    assert history[-1]["estimate"] == pytest.approx(history[-2]["objective"], rel=3e-3)

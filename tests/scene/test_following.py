"""A background that is fitted to every candidate."""

import math

import pytest
import torch
from small_scene import PLAIN, SCREW, image, pose, scene

from torchkcreg.registration import Stage, StageRun
from torchkcreg.registration.estimated_background import facing_data
from torchkcreg.scene import RegistrationData
from torchkcreg.scene.following import FollowingBackground

SHAPE = (2, 48, 40)


def images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Primary of a bar, a smooth factor, and how both kinds of scatter are spread."""
    rows, cols = torch.meshgrid(torch.arange(48.0), torch.arange(40.0), indexing="ij")
    bar = torch.where((cols - 20).abs() < 4, 0.2, 0.8).expand(SHAPE)
    return (
        bar,
        (0.7 + 0.004 * rows).expand(SHAPE),
        torch.stack([0.5 + 0.01 * cols, 0.9 - 0.01 * cols])[:, None].expand(2, *SHAPE),
    )


@pytest.mark.parametrize(("scatter", "removed"), [(0.0, 0.0), (0.2, 0.0), (0.1, 0.15)])
def test_a_smooth_factor_of_the_primary_is_followed_whatever_the_scatter(scatter: float, removed: float) -> None:
    bar, factor, shapes = images()
    scattered = scatter * shapes[0] + removed * shapes[1]
    measured = -torch.log(bar * factor + scattered)
    lines = math.log1p(scatter) - torch.log(bar + scattered)
    followed = FollowingBackground(measured, torch.ones(SHAPE, dtype=torch.bool), shapes, 5.0)
    result = followed(lines[None], torch.tensor([[scatter, removed]]))[0]
    inner = (slice(None), slice(8, -8), slice(None))
    assert float((result - math.log1p(scatter) - measured)[inner].abs().max()) < 0.02
    assert float((lines - math.log1p(scatter) - measured)[inner].abs().max()) > 0.1


def test_pixels_that_do_not_count_change_nothing() -> None:
    bar, factor, shapes = images()
    measured = -torch.log(bar * factor)
    mask = torch.ones(SHAPE, dtype=torch.bool)
    mask[:, 20:24, 10:14] = False
    spoilt = torch.where(mask, measured, 9.0)
    lines, none = -torch.log(bar)[None], torch.zeros(1, 2)
    first, second = (FollowingBackground(m, mask, shapes, 5.0)(lines, none) for m in (measured, spoilt))
    torch.testing.assert_close(first, second)


def test_no_primary_gives_no_nan() -> None:
    shapes = images()[2]
    followed = FollowingBackground(torch.full(SHAPE, 3.0), torch.ones(SHAPE, dtype=torch.bool), shapes, 5.0)
    result = followed(torch.full((1, *SHAPE), 12.0), torch.tensor([[0.5, 0.2]]))
    assert bool(result.isfinite().all())


def test_the_gradient_of_an_objective_goes_through_it() -> None:
    config = PLAIN.model_copy(update={"material": "steel", "scatter": 0.05, "background_material": "cortical_bone"})
    true = scene(config, pose(0.4, 0.3), components=[SCREW])
    modelled = image(true, background=torch.full((3, 160, 96), 20.0))
    data = RegistrationData(modelled.geometry, modelled.line_integrals - math.log(1.05))
    stage = Stage(bin=2, oversampling=1, similarity="gradient-difference", estimate=("scatter", "hardness"))
    here = scene(config, components=[SCREW])
    run = StageRun(here, facing_data(here, data, config), stage, config)
    run.with_background()
    objective = run.objective
    rest = objective.at_rest[0]
    _, gradient = objective.loss_and_gradient(rest)
    steps = 0.02 * torch.eye(len(rest), dtype=torch.float64)
    slopes = (objective.losses(rest + steps) - objective.losses(rest - steps)) / 0.04
    torch.testing.assert_close(gradient, slopes, atol=2e-3, rtol=0.05)
    assert float(slopes.abs().max()) > 0.02


def test_estimates_go_on_beyond_the_detector() -> None:
    modelled = image(scene(PLAIN))
    rows, cols = modelled.geometry.det_shape
    background = torch.arange(rows, dtype=torch.float32)[:, None].expand(3, rows, cols).contiguous()
    data = RegistrationData(modelled.geometry, modelled.line_integrals, background=background)
    window = data.windowed(scene(PLAIN).assemblies[0].nodes(4) + torch.tensor([0.0, 0.0, 40.0]), 4.0)
    beyond = ~window.mask
    assert bool(beyond.any())
    assert bool((window.background[beyond] == rows - 1).all())

import math

import pytest
import torch
import trimesh

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import TwoLevelGrid, VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.reconstruction import (
    BeamModel,
    PWLSConfig,
    TwoLevelRoughness,
    TwoLevelSystem,
    VoxelRoughness,
    VoxelSystem,
    pwls,
    reconstruct,
)

COARSE = VolumeGrid.centered((10, 14, 14), 1.2)
GEOMETRY = circular_geometry(range(0, 360, 20), sad=404, sdd=538, det_shape=(16, 28), pixel_spacing=(1.0, 1.0))
VIEWS = range(GEOMETRY.num_views)


def two_levels(factor=3, radius=3.0):
    return TwoLevelGrid(COARSE, COARSE.points().norm(dim=-1) < radius, factor)


def random(shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("factor", "oversampling"), [(2, 1), (3, 2)])
def test_backproject_is_the_adjoint(factor, oversampling):
    grid = two_levels(factor)
    system = TwoLevelSystem(GEOMETRY, grid, oversampling=oversampling)
    image, data = random(grid.shape) * grid.active, random((len(VIEWS), *GEOMETRY.det_shape), 1)
    forward = (system.project(image, VIEWS) * data).sum()
    assert math.isclose(forward, (image * system.backproject(data, VIEWS)).sum(), rel_tol=1e-9)


def test_an_image_of_one_value_shows_no_border_between_the_levels():
    grid = two_levels()
    uniform = VoxelSystem(GEOMETRY, COARSE).project(torch.full(COARSE.shape, 0.02), VIEWS)
    assert torch.allclose(TwoLevelSystem(GEOMETRY, grid).project(0.02 * grid.active, VIEWS), uniform, atol=1e-6)


def test_the_projection_is_that_of_a_fine_grid():
    """Of a ball that lies within the divided voxels, on pixels as fine as the voxels."""
    grid = two_levels(radius=4.5)
    ball = (grid.fine.points().norm(dim=-1) < 2.0).float()
    image = grid.join(torch.zeros(COARSE.shape), ball)
    fine = VoxelSystem(GEOMETRY.refined(2), grid.fine).project(ball, VIEWS)
    expected = torch.nn.functional.avg_pool2d(fine[:, None], 2)[:, 0]
    found = TwoLevelSystem(GEOMETRY, grid).project(image, VIEWS)
    assert (found - expected).abs().max() < 0.06 * expected.max()
    assert found.sum() == pytest.approx(float(expected.sum()), rel=0.02)


def test_the_roughness_has_its_gradient_and_parabolas_above_it():
    grid = two_levels()
    rough, step = TwoLevelRoughness(grid), random(grid.shape, 1) * grid.active
    image = (random(grid.shape) * grid.active).requires_grad_()
    (expected,) = torch.autograd.grad(rough.value(image), image)
    image = image.detach()
    assert torch.allclose(rough.gradient(image), expected)
    bound = rough.value(image) + (expected * step).sum() + 0.5 * (rough.curvature(image) * step**2).sum()
    assert rough.value(image + step) <= bound
    assert rough.value(grid.active.double()) == 0


def test_a_slope_is_as_rough_on_two_levels_as_on_one():
    """Across the faces where they meet, too: along x nothing of the slope is lost or counted twice."""
    grid = TwoLevelGrid(COARSE, torch.ones(COARSE.shape), 3)
    slope = lambda g: g.points(dtype=torch.float64)[..., 0]  # noqa: E731
    image = grid.join(slope(COARSE), slope(grid.fine))
    one, two = VoxelRoughness(COARSE.spacing).value(slope(COARSE)), TwoLevelRoughness(grid).value(image)
    inner, outer = 12 * 12 * 8, 14 * 14 * 10
    assert two == pytest.approx(float(one), rel=2 * (1 - inner / outer) * 0.2)
    partly = two_levels()
    assert TwoLevelRoughness(partly).value(partly.join(slope(COARSE), slope(partly.fine))) == pytest.approx(
        float(one), rel=0.02
    )


def test_pwls_on_two_levels_finds_what_one_level_cannot_hold():
    """A wire thinner than a coarse voxel, in water."""
    grid = two_levels(radius=4.0)
    points = grid.fine.points()
    wire = ((points[..., 0] ** 2 + (points[..., 1] - 0.6) ** 2) < 0.36).float() * 0.05
    truth = grid.join(torch.full(COARSE.shape, 0.02), 0.02 + wire)
    system = TwoLevelSystem(GEOMETRY, grid, oversampling=3)
    data = system.project(truth, VIEWS)
    result = pwls(
        system,
        data,
        torch.ones_like(data),
        PWLSConfig(iterations=80, subsets=6, beta=1e-3),
        mask=grid.active,
        roughness=TwoLevelRoughness(grid),
    )
    plain = pwls(
        VoxelSystem(GEOMETRY, COARSE), data, torch.ones_like(data), PWLSConfig(iterations=80, subsets=6, beta=1e-3)
    )
    fine, coarse = grid.volumes(result.volume)[1], grid.interpolated(plain.volume)
    error = lambda volume: (volume - grid.split(truth)[1])[grid.within].square().mean().sqrt()  # noqa: E731
    assert error(fine) < 0.7 * error(coarse)


def test_known_metal_on_two_levels_leaves_water_alone():
    """The same scan on one level and on two; only the last pass divides voxels."""
    box = trimesh.creation.box((5.0, 2.0, 4.0))
    metal = [KnownComponent.from_mesh(box, "titanium", pitch=0.25)]
    beam = BeamModel.monoenergetic([0.3])
    sizes = VolumeGrid.centered((12, 24, 24), 1.0)
    water = 0.02 * (sizes.points()[..., :2].norm(dim=-1) < 9)
    system = VoxelSystem(GEOMETRY, sizes)
    share = metal[0].fraction(sizes)
    line_integrals = system.project(water * (1 - share) + 0.3 * share, VIEWS)
    grid = TwoLevelGrid(COARSE, COARSE.points().norm(dim=-1) < 5.0, 2)
    options = {"components": metal, "config": PWLSConfig(iterations=20, subsets=6, beta=0.1), "passes": 2}
    found = reconstruct(torch.exp(-line_integrals), GEOMETRY, grid, beam, **options)
    assert tuple(found.volume.shape) == tuple(found.mask.shape) == grid.shape
    coarse, fine = grid.volumes(found.volume)
    assert coarse.shape == COARSE.shape
    near = grid.within & (metal[0].fraction(grid.fine) == 0)
    assert fine[near].mean() == pytest.approx(0.02, rel=0.05)
    one = reconstruct(torch.exp(-line_integrals), GEOMETRY, COARSE, beam, **options).volume
    away = ~grid.divided
    assert (coarse - one)[away].abs().mean() < 0.001


def test_a_stopped_run_on_two_levels_goes_on_to_the_same_volume():
    system = VoxelSystem(GEOMETRY, COARSE)
    transmission = torch.exp(-system.project(0.02 * (COARSE.points()[..., :2].norm(dim=-1) < 7), VIEWS))
    kept = {}

    class Keeps(Callback):
        def on_iteration(self, run, index, progress):
            if index == 1 and progress["iteration"] == 2:
                kept.update({"pass": index, "solver": run.state_dict(), "volume": run.initial.clone()})

    options = {"config": PWLSConfig(iterations=4, subsets=3), "passes": 2}
    beam, grid = BeamModel.monoenergetic([]), two_levels()
    whole = reconstruct(transmission, GEOMETRY, grid, beam, callbacks=[Keeps()], **options)
    resumed = reconstruct(transmission, GEOMETRY, grid, beam, state=kept, **options)
    assert torch.equal(whole.volume, resumed.volume)

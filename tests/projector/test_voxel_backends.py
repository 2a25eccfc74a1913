from __future__ import annotations

import pytest
import torch
from voxel_scenes import DET_SHAPE, GRIDS, KINDS, straight_grid, views

from torchkcreg.geometry import VolumeGrid
from torchkcreg.kernels import unavailable_reason
from torchkcreg.projector import backproject, backproject_weighted, project_volume
from torchkcreg.projector.voxels import _rays

BACKENDS = ("cpp", "torch")


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels():
    if unavailable_reason() is not None:
        pytest.skip("the C++ kernels can be neither loaded nor compiled here")


def noise(*shape, dtype=torch.float64, seed=0):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def relative(values, truth):
    return float((values - truth).norm() / truth.norm())


def operations(grid, matrices, dtype):
    """The three operators on noise, each a function of the backend."""
    volume, images = noise(2, *grid.shape, dtype=dtype), noise(2, len(matrices), *DET_SHAPE, dtype=dtype, seed=1)
    return {
        "project": lambda backend: project_volume(volume, grid, matrices, DET_SHAPE, backend=backend),
        "backproject": lambda backend: backproject(images, grid, matrices, backend=backend),
        "weighted": lambda backend: backproject_weighted(images, grid, matrices, backend=backend),
    }


# Voxels much smaller than pixels, as large, and much larger: the kernels look values up in different ways.
@pytest.mark.parametrize("size", [0.06, 0.4, 1.0, 3.0, 9.0])
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-5), (torch.float64, 1e-12)])
def test_cpp_gives_the_numbers_of_the_reference(dtype, tolerance, kind, grid, size):
    base = GRIDS[grid]()
    grid = VolumeGrid.centered(
        base.shape, tuple(size * d for d in base.spacing), center=(3.0, -2.0, 1.0), direction=base.direction
    )
    for name, operation in operations(grid, views(kind), dtype).items():
        expected = operation("torch")
        assert expected.abs().max() > 0, name
        assert relative(operation("cpp"), expected) < tolerance, name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_projection_and_backprojection_are_adjoint(dtype, tolerance, kind, grid, backend):
    grid, matrices = GRIDS[grid](), views(kind)
    # signed values, so that the two sums are no sums of weights only
    x, y = noise(*grid.shape, dtype=dtype) - 0.5, noise(5, *DET_SHAPE, dtype=dtype, seed=1) - 0.5
    images = project_volume(x, grid, matrices, DET_SHAPE, backend=backend).double()
    volume = backproject(y, grid, matrices, backend=backend).double()
    scale = float(images.norm() * y.double().norm())
    assert abs(float((images * y).sum() - (x * volume).sum())) < tolerance * scale


@pytest.mark.parametrize("kind", ["upright", "tilted"])
def test_backends_agree_and_are_adjoint_with_the_source_inside_the_volume(kind):
    matrices = views(kind)[:1]
    source = -torch.linalg.solve(matrices[0, :, :3], matrices[0, :, 3])
    grid = VolumeGrid.centered((14, 18, 20), (1.9, 2.3, 1.6), center=(source - 3).tolist())
    x, y = noise(*grid.shape) - 0.5, noise(1, *DET_SHAPE, seed=1) - 0.5
    images = project_volume(x, grid, matrices, DET_SHAPE, backend="cpp")
    volume = backproject(y, grid, matrices, backend="cpp")
    torch.testing.assert_close(images, project_volume(x, grid, matrices, DET_SHAPE, backend="torch"))
    torch.testing.assert_close(volume, backproject(y, grid, matrices, backend="torch"))
    torch.testing.assert_close((images * y).sum(), (x * volume).sum())
    assert volume.abs().max() > 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", ["upright", "steep"])
def test_gradients_are_those_of_finite_differences(kind, backend):
    grid, matrices, shape = straight_grid((2, 3, 3)), views(kind)[:2], (4, 4)
    middle = torch.tensor([[1, 0, -13.0], [0, 1, -10.0], [0, 0, 1]]).double()  # a crop about the image of the grid
    matrices = middle @ matrices
    x = noise(1, *grid.shape).requires_grad_()
    y = noise(1, 2, *shape, seed=1).requires_grad_()
    assert project_volume(x, grid, matrices, shape).abs().max() > 0
    for function, data in (
        (lambda t: project_volume(t, grid, matrices, shape, backend=backend), x),
        (lambda t: backproject(t, grid, matrices, backend=backend), y),
        (lambda t: 1e5 * backproject_weighted(t, grid, matrices, backend=backend), y),
    ):
        assert torch.autograd.gradcheck(function, data)
    for function, data in (
        (lambda t: project_volume(t, grid, matrices, shape, backend=backend).square(), x),
        (lambda t: backproject(t, grid, matrices, backend=backend).square(), y),
    ):
        assert torch.autograd.gradgradcheck(function, data)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_operators_pass_opcheck(dtype):
    grid, matrices = straight_grid((3, 4, 5)), views("tilted")[:2]
    volume = noise(2, *grid.shape, dtype=dtype).requires_grad_()
    images = noise(2, 2, 6, 7, dtype=dtype).requires_grad_()
    rays, spacing = _rays(grid, matrices, volume)
    ops = torch.ops.torchkcreg
    torch.library.opcheck(ops.voxel_project, (volume, rays, spacing, 6, 7))
    torch.library.opcheck(ops.voxel_backproject, (images, rays, spacing, *grid.shape))
    torch.library.opcheck(ops.voxel_backproject_weighted, (images, matrices @ grid.voxel_to_world, *grid.shape))


@pytest.mark.parametrize("kind", KINDS)
def test_bits_do_not_depend_on_the_number_of_threads(kind):
    results = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append([f("cpp") for f in operations(straight_grid(), views(kind), torch.float32).values()])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_memory_layout_does_not_matter():
    grid, matrices = straight_grid(), views("upright")
    volume, images = noise(*grid.shape), noise(5, *DET_SHAPE)
    turned = volume.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert torch.equal(
        project_volume(turned, grid, matrices, DET_SHAPE), project_volume(volume, grid, matrices, DET_SHAPE)
    )
    for function in (backproject, backproject_weighted):
        spaced = torch.stack([images, images], -1)[..., 0]
        assert torch.equal(function(spaced, grid, matrices.mT.contiguous().mT), function(images, grid, matrices))


def test_a_slice_of_the_views_is_projected_like_a_copy():
    grid, matrices = straight_grid(), views("tilted")
    images = noise(2, 5, *DET_SHAPE)
    for function in (backproject, backproject_weighted):
        for part in (images[:, 1::2], images[1:, 1::2]):
            assert torch.equal(function(part, grid, matrices[1::2]), function(part.clone(), grid, matrices[1::2]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_views_and_no_candidates_give_empty_results(backend):
    grid, matrices = straight_grid(), views("upright")
    volume = noise(*grid.shape)
    assert project_volume(volume, grid, matrices[:0], DET_SHAPE, backend=backend).shape == (0, *DET_SHAPE)
    assert project_volume(volume[None][:0], grid, matrices, DET_SHAPE, backend=backend).shape == (0, 5, *DET_SHAPE)
    for function in (backproject, backproject_weighted):
        assert function(noise(0, *DET_SHAPE), grid, matrices[:0], backend=backend).eq(0).all()
        assert function(noise(1, 5, *DET_SHAPE)[:0], grid, matrices, backend=backend).shape == (0, *grid.shape)


def test_kernels_check_shapes_themselves():
    grid, matrices = straight_grid(), views("upright")
    volume, images = noise(1, *grid.shape), noise(1, 5, *DET_SHAPE)
    rays, spacing = _rays(grid, matrices, volume)
    ops = torch.ops.torchkcreg
    for call in (
        lambda: ops.voxel_project(volume[0], rays, spacing, 4, 4),
        lambda: ops.voxel_project(volume.long(), rays, spacing, 4, 4),
        lambda: ops.voxel_project(volume, rays.float(), spacing, 4, 4),
        lambda: ops.voxel_project(volume, rays, spacing[:2], 4, 4),
        lambda: ops.voxel_project(volume, rays, spacing, 0, 4),
        lambda: ops.voxel_backproject(images, rays[:3], spacing, *grid.shape),
        lambda: ops.voxel_backproject_weighted(images, matrices[:, :, :3], *grid.shape),
        lambda: ops.voxel_backproject_weighted(images, matrices, 0, 4, 4),
    ):
        with pytest.raises(RuntimeError):
            call()

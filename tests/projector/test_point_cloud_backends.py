from __future__ import annotations

import pytest
import torch
from drr_bodies import camera, lattice, rotation

from torchkcreg.kernels import choose_backend, unavailable_reason
from torchkcreg.projector import cell_footprint, project_points
from torchkcreg.projector.point_ops import point_drr

SHAPE = (20, 26)
CELL = 0.25 * torch.eye(3, dtype=torch.float64)


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels():
    if unavailable_reason() is not None:
        pytest.skip("the C++ kernels can be neither loaded nor compiled here")


def some_nodes(*, dtype=torch.float64, candidates=2, num_blocks=3, scale=1.0, strewn=False, size=(1.0, 6.0, 8.0)):
    """Arguments of point_drr: an oblique body that leaves the detector in part; the last block is short."""
    generator = torch.Generator().manual_seed(0)
    turn = rotation((1, 2, 3), 30)
    points = lattice(size) @ turn.T
    if strewn:
        points = points[torch.randperm(len(points), generator=generator)]
    shifts = torch.randn(candidates, 1, 3, dtype=torch.float64, generator=generator)
    volumes = torch.rand(len(points), dtype=torch.float64, generator=generator)
    matrices = torch.cat([camera(a, det_shape=SHAPE, source_z=z) for a, z in ((10, 120.0), (50, 0.0), (95, -120.0))])
    block_size = -(-len(points) // num_blocks) + 7
    footprint = cell_footprint(points, scale * CELL @ turn.T, matrices, block_size=block_size)
    tensors = [t.to(dtype) for t in (points + shifts, volumes * 1e4, matrices, footprint.table)]
    return *tensors, block_size, *SHAPE


def few_nodes(dtype=torch.float64):
    """A handful of nodes, some of them at the border and out of sight, for gradcheck and opcheck."""
    generator = torch.Generator().manual_seed(3)
    points = 3 * torch.randn(2, 7, 3, dtype=torch.float64, generator=generator)
    points[0, 0] = torch.tensor([500.0, 0, 0])
    matrices = torch.cat([camera(10, det_shape=(9, 12)), camera(95, det_shape=(9, 12))])
    table = cell_footprint(points, CELL @ rotation((1, 2, 3), 30), matrices, block_size=3).table
    volumes = torch.rand(7, dtype=torch.float64, generator=generator)
    return [t.to(dtype) for t in (points, volumes, matrices, table)] + [3, 9, 12]


def gradients(arguments, backend):
    """Gradients to points, volumes and matrices of a sum with random signs."""
    leaves = [t.clone().requires_grad_() for t in arguments[:3]]
    image = point_drr(*leaves, *arguments[3:], backend=backend)
    weight = torch.randn(image.shape, dtype=image.dtype, generator=torch.Generator().manual_seed(5))
    return torch.autograd.grad((image * weight).sum(), leaves)


@pytest.mark.parametrize("strewn", [False, True], ids=["neighbours", "strewn"])
@pytest.mark.parametrize("scale, taps", [(1.0, 4), (2.6, 6), (4.0, 8), (6.0, 12)])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-11), (torch.float32, 3e-4)])
def test_cpp_draws_and_differentiates_like_the_reference(dtype, tolerance, scale, taps, strewn):
    arguments = some_nodes(dtype=dtype, scale=scale, strewn=strewn, num_blocks=10 if strewn else 3)
    assert arguments[3].shape[-1] == taps
    expected = point_drr(*arguments, backend="torch")
    assert (expected.amax((-1, -2)) > 0).all()
    image = point_drr(*arguments, backend="cpp")
    assert (image - expected).abs().max() < tolerance * expected.abs().max()
    for ours, reference in zip(gradients(arguments, "cpp"), gradients(arguments, "torch")):
        assert ours.dtype == dtype
        # In float32 a node next to a tabulated phase may fall on its other side, where the slope is another.
        assert (ours - reference).norm() < 30 * tolerance * reference.norm()


def summaries(images):
    """Eight random sums of the images: gradcheck then needs eight backward passes, not one for each pixel."""
    weights = torch.randn(8, *images.shape, dtype=images.dtype, generator=torch.Generator().manual_seed(6))
    return (weights * images).flatten(1).sum(1)


@pytest.mark.parametrize("backend", ["cpp", "torch"])
def test_gradients_of_the_operator_are_those_of_finite_differences(backend):
    *tensors, table, block_size, rows, cols = few_nodes()
    tensors = [t.requires_grad_() for t in tensors]
    assert torch.autograd.gradcheck(
        lambda *t: 404**2 * summaries(point_drr(*t, table, block_size, rows, cols, backend=backend)),
        tensors,
        eps=1e-6,
        atol=1e-5,
    )


@pytest.mark.parametrize("backend", ["cpp", "torch"])
def test_gradients_of_project_points_are_those_of_finite_differences(backend):
    points, volumes, matrices, _, block_size, rows, cols = few_nodes()
    footprint = cell_footprint(points, CELL, matrices, block_size=block_size)
    assert torch.autograd.gradcheck(
        lambda *t: summaries(project_points(*t, (rows, cols), footprint=footprint, backend=backend)),
        [t.requires_grad_() for t in (points, volumes, matrices)],
        eps=1e-6,
        atol=1e-5,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_operators_pass_opcheck(dtype):
    arguments = few_nodes(dtype)
    tensors = [t.clone().requires_grad_() for t in arguments[:3]]
    torch.library.opcheck(torch.ops.torchkcreg.point_drr, (*tensors, *arguments[3:]))
    grad = torch.ones(2, 2, 9, 12, dtype=dtype)
    for needs in ((False, False), (True, False), (True, True)):
        torch.library.opcheck(torch.ops.torchkcreg.point_drr_backward, (grad, *arguments[:5], *needs))


def test_projection_and_gradient_of_the_volumes_are_adjoint():
    points, volumes, *rest = some_nodes()
    y = torch.randn(2, 3, *SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    leaf = volumes.clone().requires_grad_()
    image = point_drr(points, leaf, *rest, backend="cpp")
    (back,) = torch.autograd.grad(image, leaf, y)
    torch.testing.assert_close((image * y).sum(), (volumes * back).sum(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("candidates", [1, 5])
def test_bits_do_not_depend_on_the_number_of_threads(candidates, dtype):
    arguments = some_nodes(candidates=candidates, dtype=dtype)
    results = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append([point_drr(*arguments, backend="cpp"), *gradients(arguments, "cpp")])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_more_tiles_than_are_held_at_once_give_the_same_images():
    arguments = some_nodes(candidates=60, num_blocks=4)  # 60 * 3 * 4 chunks or more
    together = point_drr(*arguments, backend="cpp")
    for i in (0, 31, 42, 59):
        assert torch.equal(together[i : i + 1], point_drr(arguments[0][i : i + 1], *arguments[1:], backend="cpp"))


def test_blocks_longer_than_a_chunk_are_drawn_whole():
    arguments = some_nodes(num_blocks=1, size=(1.5, 8.0, 16.0))
    assert arguments[4] > 10_000
    expected = point_drr(*arguments, backend="torch")
    torch.testing.assert_close(point_drr(*arguments, backend="cpp"), expected, rtol=1e-9, atol=1e-12)


def test_memory_layout_does_not_matter():
    points, volumes, matrices, table, *rest = some_nodes()
    expected = point_drr(points, volumes, matrices, table, *rest, backend="cpp")
    turned = point_drr(
        points.mT.contiguous().mT,
        torch.stack([volumes, volumes], 1)[:, 0],
        matrices.mT.contiguous().mT,
        table.transpose(-1, 0).contiguous().transpose(-1, 0),
        *rest,
        backend="cpp",
    )
    assert torch.equal(turned, expected)


def test_only_needed_gradients_are_computed():
    points, volumes, matrices, table, block_size, *_ = some_nodes()
    grad = torch.ones(2, 3, *SHAPE, dtype=torch.float64)
    backward = torch.ops.torchkcreg.point_drr_backward
    everything = backward(grad, points, volumes, matrices, table, block_size, True, True)
    points_only = backward(grad, points, volumes, matrices, table, block_size, False, False)
    assert [g.numel() for g in points_only[1:]] == [0, 0]
    torch.testing.assert_close(points_only[0], everything[0], rtol=1e-12, atol=1e-12)


def test_nothing_to_draw_gives_empty_images():
    points, volumes, matrices, table, *rest = some_nodes()
    for backend in ("cpp", "torch"):
        assert point_drr(points[:0], volumes, matrices, table, *rest, backend=backend).shape == (0, 3, *SHAPE)
        assert point_drr(points, volumes, matrices[:0], table[:0], *rest, backend=backend).shape == (2, 0, *SHAPE)


def test_kernels_check_shapes_themselves():
    arguments = list(some_nodes())
    for index, wrong in ((0, torch.zeros(5, 3)), (1, torch.zeros(3)), (2, torch.zeros(3, 4)), (3, torch.zeros(2, 3))):
        changed = [*arguments]
        changed[index] = wrong.double()
        with pytest.raises(RuntimeError):
            torch.ops.torchkcreg.point_drr(*changed)
    with pytest.raises(RuntimeError):
        torch.ops.torchkcreg.point_drr(arguments[0].float(), *arguments[1:])


def test_auto_takes_cpp_on_the_cpu():
    assert choose_backend(torch.zeros(1), "auto").name == "cpp"
    assert choose_backend(torch.zeros(1), "torch").is_reference
    assert choose_backend(torch.zeros(1, device="meta"), "auto").name == "torch"
    with pytest.raises(ValueError, match="needs tensors on the CPU"):
        choose_backend(torch.zeros(1, device="meta"), "cpp")

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from torchkcreg.geometry import (
    fit_rigid,
    invert_rigid,
    rigid_matrix,
    rotation_from_vector,
    transform_points,
    vector_from_rotation,
)


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.5, 2.0, 3.1, math.pi])
def test_rotations_agree_with_scipy_at_every_angle(length: float) -> None:
    axes = torch.nn.functional.normalize(_random(20, 3), dim=-1)
    ours = rotation_from_vector(axes * length)
    theirs = torch.from_numpy(Rotation.from_rotvec((axes * length).numpy()).as_matrix())
    torch.testing.assert_close(ours, theirs, rtol=0, atol=2e-15)
    back = vector_from_rotation(ours)
    if length == math.pi:
        back = back * (back * axes).sum(-1, keepdim=True).sign()  # a half turn has two vectors
    torch.testing.assert_close(back, axes * length, rtol=0, atol=1e-14)


def test_tiny_rotations_keep_their_relative_precision() -> None:
    vector = torch.tensor([1e-12, -2e-12, 3e-12], dtype=torch.float64)
    torch.testing.assert_close(vector_from_rotation(rotation_from_vector(vector)), vector, rtol=1e-12, atol=0)


@pytest.mark.parametrize("length", [0.0, 0.02, 0.04, 1.0, 3.0])
def test_gradients_of_rotation_and_vector_are_right(length: float) -> None:
    vector = torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64) * length
    assert gradcheck(rotation_from_vector, vector.clone().requires_grad_())

    def around(step: torch.Tensor) -> torch.Tensor:  # stays on the manifold
        return vector_from_rotation(rotation_from_vector(vector) @ rotation_from_vector(step))

    assert gradcheck(around, torch.zeros(1, 3, dtype=torch.float64, requires_grad=True))


def test_a_rigid_matrix_and_its_inverse_cancel() -> None:
    matrix = rigid_matrix(_random(4, 1, 3), 50 * _random(5, 3, seed=1))
    points = 100 * _random(4, 5, 7, 3, seed=2)
    assert matrix.shape == (4, 5, 4, 4)
    torch.testing.assert_close(transform_points(invert_rigid(matrix), transform_points(matrix, points)), points)
    torch.testing.assert_close(matrix @ invert_rigid(matrix), torch.eye(4, dtype=torch.float64).expand(4, 5, 4, 4))


def test_points_keep_their_dtype_and_a_batch_of_matrices_broadcasts() -> None:
    matrix = rigid_matrix(_random(6, 3), _random(6, 3, seed=1))
    points = torch.ones(10, 3)
    moved = transform_points(matrix, points)
    assert moved.shape == (6, 10, 3) and moved.dtype == torch.float32
    by_hand = matrix[2, :3, :3] @ points[4].double() + matrix[2, :3, 3]
    torch.testing.assert_close(moved[2, 4].double(), by_hand, rtol=0, atol=1e-6)


def test_a_rigid_motion_is_recovered_exactly_and_in_batches() -> None:
    truth = rigid_matrix(_random(8, 3), 40 * _random(8, 3, seed=1))
    source = torch.tensor([5.0, 20.0, 90.0], dtype=torch.float64) * _random(8, 12, 3, seed=2)
    torch.testing.assert_close(fit_rigid(source, transform_points(truth, source)), truth, rtol=0, atol=1e-11)


def test_weights_say_which_points_count() -> None:
    truth = rigid_matrix(_random(3), _random(3, seed=1))
    source = _random(10, 3, seed=2)
    target = transform_points(truth, source)
    target[7:] += 5.0
    weights = torch.ones(10, dtype=torch.float64)
    weights[7:] = 0.0
    torch.testing.assert_close(fit_rigid(source, target, weights), truth, rtol=0, atol=1e-12)
    doubled = torch.cat([source, source[:3]]), torch.cat([target, target[:3]])
    weights = torch.ones(10, dtype=torch.float64)
    weights[:3] = 2.0
    torch.testing.assert_close(fit_rigid(source, target, weights), fit_rigid(*doubled), rtol=0, atol=1e-12)


def test_the_fit_agrees_with_scipy_on_noisy_points() -> None:
    source, target = _random(30, 3), _random(30, 3, seed=1)
    centred = source - source.mean(0), target - target.mean(0)
    theirs, _ = Rotation.align_vectors(centred[1].numpy(), centred[0].numpy())
    ours = fit_rigid(source, target)
    torch.testing.assert_close(ours[:3, :3], torch.from_numpy(theirs.as_matrix()), rtol=0, atol=1e-12)
    torch.testing.assert_close(transform_points(ours, source).mean(0), target.mean(0))


def test_a_mirrored_target_still_gives_a_proper_rotation() -> None:
    source = _random(20, 3)
    fitted = fit_rigid(source, source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert torch.linalg.det(fitted[:3, :3]).item() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_a_line_take_the_smallest_rotation(dtype: torch.dtype) -> None:
    axis = torch.tensor([0.48, 0.6, 0.64], dtype=dtype)
    offset = torch.tensor([30.0, -100.0, 200.0], dtype=dtype)
    source = torch.linspace(-20, 20, 5, dtype=dtype)[:, None] * axis + offset
    across = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.eye(3, dtype=dtype)[0]), dim=-1)
    truth = rigid_matrix(0.3 * across, torch.tensor([1.0, 2.0, 3.0], dtype=dtype))
    tolerance = 1e-11 if dtype == torch.float64 else 3e-5
    fitted = fit_rigid(source, transform_points(truth, source))
    torch.testing.assert_close(fitted[:3, :3], truth[:3, :3], rtol=0, atol=tolerance)


def test_a_single_point_only_translates() -> None:
    source = torch.tensor([[101.3, 7.7, -33.1]], dtype=torch.float64)
    fitted = fit_rigid(source, source + torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))
    torch.testing.assert_close(fitted[:3, :3], torch.eye(3, dtype=torch.float64), rtol=0, atol=0)
    torch.testing.assert_close(fitted[:3, 3], torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))


def test_the_gradient_of_the_fit_is_right() -> None:
    source, target = _random(2, 6, 3), _random(2, 6, 3, seed=1)
    weights = _random(6, seed=2).abs() + 0.1
    inputs = [tensor.requires_grad_() for tensor in (source, target, weights)]
    assert gradcheck(fit_rigid, inputs)


def test_the_gradient_of_the_fit_is_right_where_singular_values_meet() -> None:
    cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    assert gradcheck(lambda target: fit_rigid(cube, target), cube.clone().requires_grad_())


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_gradient_of_the_fit_stays_finite_for_few_points(count: int) -> None:
    source = torch.eye(3, dtype=torch.float64)[:count].requires_grad_()
    fit_rigid(source, source + 1.0).sum().backward()
    assert source.grad is not None and source.grad.isfinite().all()


def test_wrong_shapes_and_weights_are_refused() -> None:
    with pytest.raises(ValueError, match="rotation_vector must have shape"):
        rotation_from_vector(torch.zeros(4))
    with pytest.raises(ValueError, match="rotation must have shape"):
        vector_from_rotation(torch.zeros(4, 4))
    with pytest.raises(ValueError, match="matrix must have shape"):
        transform_points(torch.eye(3), torch.zeros(5, 3))
    with pytest.raises(ValueError, match="same points"):
        fit_rigid(torch.zeros(5, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="weights must have shape"):
        fit_rigid(torch.zeros(5, 3), torch.zeros(5, 3), torch.ones(4))
    with pytest.raises(ValueError, match="weights must not be negative"):
        fit_rigid(torch.zeros(5, 3), torch.zeros(5, 3), -torch.ones(5))

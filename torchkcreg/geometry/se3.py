"""Rigid motions as 4 x 4 matrices: rotation vectors, inverses, weighted least-squares fit (Kabsch), principal axes.

Points are rows, `(..., N, 3)`, and a matrix acts as `x -> R x + t`. The rigid motions are batched over leading
dimensions and differentiable, also at the identity, where the textbook formulas divide zero by zero.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL_ANGLE_SQUARED = 1e-3  # below it Taylor series are used, with a truncation error under 1e-16


def principal_axes(points: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (3,) of points (N, 3) and their principal axes (3, 3), one per row, from least to largest variance.

    The signs of the axes are arbitrary.
    """
    center = points.mean(0)
    return center, torch.linalg.eigh((points - center).mT @ (points - center)).eigenvectors.mT


def _check_last(name: str, tensor: Tensor, *sizes: int) -> None:
    if tuple(tensor.shape[-len(sizes) :]) != sizes:
        expected = ", ".join(str(size) for size in sizes)
        raise ValueError(f"{name} must have shape (..., {expected}), got {tuple(tensor.shape)}")


def _skew(vector: Tensor) -> Tensor:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `_skew(a) @ b = a x b`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def rotation_from_vector(rotation_vector: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3): axis times angle in radians.

    Rodrigues' formula `R = I + a K + b K^2` with `a = sin(t)/t`, `b = (1 - cos t)/t^2` and `K` the
    cross-product matrix. Values and derivatives are also right at zero.

    >>> quarter_turn_about_z = rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2]))
    >>> (quarter_turn_about_z @ torch.tensor([1.0, 0.0, 0.0])).round().abs().tolist()
    [0.0, 1.0, 0.0]
    """
    _check_last("rotation_vector", rotation_vector, 3)
    squared = (rotation_vector * rotation_vector).sum(-1)[..., None, None]
    small = squared < _SMALL_ANGLE_SQUARED
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()  # never sqrt(0): its derivative is infinite
    a = torch.where(small, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), angle.sin() / angle)
    half_sine = (angle / 2).sin() / angle  # 1 - cos t = 2 sin^2(t/2) does not cancel
    b = torch.where(small, 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), 2 * half_sine * half_sine)
    k = _skew(rotation_vector)
    identity = torch.eye(3, dtype=rotation_vector.dtype, device=rotation_vector.device)
    return identity + a * k + b * (k @ k)


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of length at most pi of rotation matrices (..., 3, 3).

    Inverse of `rotation_from_vector`. Computed by the unit quaternion q: `4 q q^T` is linear in the matrix, and its row
    with the largest diagonal element is `q` up to a factor. This is accurate everywhere, including half turns (whose
    sign is arbitrary).

    >>> vector_from_rotation(rotation_from_vector(torch.tensor([0.125, -0.25, 0.5]))).round(decimals=4).tolist()
    [0.125, -0.25, 0.5]
    """
    _check_last("rotation", rotation, 3, 3)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation.flatten(-2).unbind(-1)
    w_row = [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy]
    x_row = [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx]
    y_row = [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy]
    z_row = [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz]
    outer = torch.stack(w_row + x_row + y_row + z_row, dim=-1).unflatten(-1, (4, 4))
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*outer.shape[:-2], 1, 4)
    row = outer.gather(-2, best).squeeze(-2)
    quaternion = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    cosine, axis = quaternion[..., :1], quaternion[..., 1:]
    squared = (axis * axis).sum(-1, keepdim=True)
    small = squared < _SMALL_ANGLE_SQUARED
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    ratio = squared / (cosine * cosine).clamp_min(0.5)  # tan^2 of half the angle; used for small angles only
    series = (1 - ratio * (1 / 3 - ratio * (1 / 5 - ratio * (1 / 7 - ratio / 9)))) / cosine.clamp_min(0.5)
    return axis * 2 * torch.where(small, series, torch.atan2(sine, cosine) / sine)


def rigid_matrix(rotation_vector: Tensor, translation: Tensor) -> Tensor:
    """Rigid transforms (..., 4, 4) from rotation vectors (..., 3) in radians and translations (..., 3) in mm.

    >>> rigid_matrix(torch.zeros(3), torch.tensor([1.0, 2.0, 3.0]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    _check_last("rotation_vector", rotation_vector, 3)
    _check_last("translation", translation, 3)
    return _assemble(rotation_from_vector(rotation_vector), translation)


def _assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    column = translation.expand(*batch, 3).unsqueeze(-1)
    top = torch.cat([rotation.expand(*batch, 3, 3), column], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device)
    return torch.cat([top, last.expand(*batch, 1, 4)], dim=-2)


def rotation_about(center: Tensor, rotation_vector: Tensor) -> Tensor:
    """Rigid transforms (..., 4, 4) that rotate by rotation vectors (..., 3) about centres (..., 3).

    >>> half_turn = rotation_about(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, torch.pi]))
    >>> transform_points(half_turn, torch.zeros(1, 3)).round().abs().tolist()
    [[2.0, 0.0, 0.0]]
    """
    turn = rotation_from_vector(rotation_vector)
    return _assemble(turn, center - (turn @ center[..., None])[..., 0])


def across(axis: Tensor) -> Tensor:
    """Two unit vectors (2, 3) that with a unit vector (3,) as the third form a right-handed frame.

    >>> across(torch.tensor([0.0, 0.0, 1.0])).abs().tolist()
    [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    coordinate_axis = torch.eye(3, dtype=axis.dtype, device=axis.device)[int(axis.abs().argmin())]
    first = torch.linalg.cross(axis, coordinate_axis)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(axis, first)])


def transform_points(matrix: Tensor, points: Tensor) -> Tensor:
    """Points (..., N, 3) moved by affine transforms (..., 4, 4), in the points' dtype; leading dimensions broadcast.

    >>> transform_points(rigid_matrix(torch.zeros(3), torch.ones(3)), torch.zeros(2, 3)).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    _check_last("matrix", matrix, 4, 4)
    _check_last("points", points, 3)
    matrix = matrix.to(points.dtype)
    if matrix.dim() == 2:  # one pass over the points
        flat = torch.addmm(matrix[:3, 3], points.reshape(-1, 3), matrix[:3, :3].mT)
        return flat.reshape(points.shape)
    return points @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]


def invert_rigid(matrix: Tensor) -> Tensor:
    """Inverses (..., 4, 4) of rigid transforms: `R^T` and `-R^T t`. Not for matrices that scale or shear."""
    _check_last("matrix", matrix, 4, 4)
    inverse = matrix[..., :3, :3].mT
    return _assemble(inverse, -(inverse @ matrix[..., :3, 3:]).squeeze(-1))


def fit_rigid(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Rigid transforms (..., 4, 4) that minimise `sum_n w_n |R s_n + t - t_n|^2`; proper rotations, batched.

    Kabsch's solution (1976), computed in double precision. Where the points do not determine the rotation (all on a
    line, or all in one place) the smallest rotation is taken, so groups of one or two points also have a motion. The
    derivative follows from the first-order condition of the optimum, not from the singular value decomposition, which
    is not differentiable where singular values coincide.

    Args:
        source: Points (..., N, 3) in mm.
        target: Positions of the same points after the motion, (..., N, 3); leading dimensions broadcast.
        weights: Weights (..., N), not negative, with a positive sum; by default all one.

    Raises:
        ValueError: Shapes do not fit, or weights are negative or sum to zero.

    >>> moved = fit_rigid(torch.eye(3), torch.eye(3) + 2.0)
    >>> moved[:3, 3].round(decimals=4).tolist()
    [2.0, 2.0, 2.0]
    """
    _check_last("source", source, 3)
    _check_last("target", target, 3)
    if source.shape[-2] != target.shape[-2] or source.shape[-2] == 0:
        raise ValueError(f"source and target must hold the same points, got {source.shape[-2]} and {target.shape[-2]}")
    dtype = torch.promote_types(source.dtype, target.dtype)
    eps = torch.finfo(dtype).eps
    source, target = source.double(), target.double()
    share = _shares(weights, source)
    source_center = (share * source).sum(-2)
    target_center = (share * target).sum(-2)
    covariance = ((target - target_center.unsqueeze(-2)) * share).mT @ (source - source_center.unsqueeze(-2))
    size = (share * source.square()).sum((-2, -1)).sqrt() * (share * target.square()).sum((-2, -1)).sqrt()
    rotation = _closest_rotation(covariance, 16 * eps * size.detach().sqrt())
    translation = target_center - (rotation @ source_center.unsqueeze(-1)).squeeze(-1)
    return _assemble(rotation, translation).to(dtype)


def _shares(weights: Tensor | None, points: Tensor) -> Tensor:
    """Weights (..., N, 1) that sum to one over the points."""
    if weights is None:
        return points.new_full((points.shape[-2], 1), 1 / points.shape[-2])
    if weights.shape[-1:] != points.shape[-2:-1]:
        raise ValueError(f"weights must have shape (..., {points.shape[-2]}), got {tuple(weights.shape)}")
    weights = weights.double()
    total = weights.sum(-1, keepdim=True)
    if bool((weights < 0).any()) or not bool((total > 0).all()):
        raise ValueError("weights must not be negative and must have a positive sum")
    return (weights / total).unsqueeze(-1)


def _closest_rotation(covariance: Tensor, noise: Tensor) -> Tensor:
    """Proper rotations (..., 3, 3) that maximise `trace(R^T A)`, differentiable in A.

    Singular values below `noise` (rounding of the coordinates, mm) times the spread of the points are treated as zero.

    `S = R^T A` is symmetric at the maximum. Differentiating that gives `dR = R W` with the skew `W` that solves
    `W S + S W = B - B^T`, where `B = R^T dA`. In the basis of the eigenvectors of S this is a division by sums of
    eigenvalues.
    """
    u, sigma, vh = torch.linalg.svd(covariance.detach())
    sign = torch.linalg.det(u @ vh)
    signs = torch.stack([torch.ones_like(sign), torch.ones_like(sign), torch.where(sign < 0, -1.0, 1.0)], dim=-1)
    eigenvalues = sigma * signs
    rotation = (u * signs.unsqueeze(-2)) @ vh
    identity = torch.eye(3, dtype=covariance.dtype, device=covariance.device)

    negligible = noise * sigma[..., 0].sqrt()
    cosine = (u[..., :, 0] * vh[..., 0, :]).sum(-1)
    on_a_line = (eigenvalues[..., 1] + eigenvalues[..., 2] <= negligible) & (cosine > -0.999)
    k = _skew(torch.linalg.cross(vh[..., 0, :], u[..., :, 0]))
    smallest = identity + k + k @ k / (1 + cosine).clamp_min(1e-3)[..., None, None]
    rotation = torch.where(on_a_line[..., None, None], smallest, rotation)
    in_one_place = sigma[..., 0] <= negligible
    rotation = torch.where(in_one_place[..., None, None], identity, rotation)

    sums = eigenvalues.unsqueeze(-1) + eigenvalues.unsqueeze(-2)
    known = (sums > negligible[..., None, None]) & ~in_one_place[..., None, None]
    inverse_sums = torch.where(known, 1 / torch.where(known, sums, 1.0), 0.0)
    product = rotation.mT @ covariance
    twist = vh.mT @ ((vh @ (product - product.mT) @ vh.mT) * inverse_sums) @ vh
    return rotation + rotation @ (twist - twist.detach())  # the bracket is zero and carries the derivative

"""Groups of control points that move rigidly: clustering, motions, and the resulting displacements of nodes.

Group g turns by R_g about its centre c_g and shifts by t_g: phi_c = (R_g - I)(c - c_g) + t_g. A spline is linear in
phi, so a node moves by sum_g W_g t_g + (R_g - I) M_g, where the moments W_g and M_g depend only on its reference
position. Everything here is in the axes of the grid's frame. CP is short for control point.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torchkcreg.splines.basis import SplineBasis
from torchkcreg.splines.grid import ControlPointGrid

# A CP that carries less than this share of the volume of the most loaded one has no implant near it. It hardly moves a
# node and must not influence the cuts.
_LEAST_LOAD = 1e-3


def control_point_volumes(grid: ControlPointGrid, points: Tensor, volumes: Tensor) -> Tensor:
    """Implant volume that each control point carries, sum_n m_n B_c(x_n), mm^3, shape (nx, ny, nz), float64.

    They add up to the implant's volume. The volume of a CP beyond the grid is added to the nearest CP of the grid.

    Args:
        grid: Control points.
        points: Nodes in the implant's frame, mm, shape (N, 3).
        volumes: Volumes of the nodes, mm^3, shape (N,).

    Raises:
        ValueError: If shapes do not fit.

    Example:
        >>> grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
        >>> carried = control_point_volumes(grid, 15 + torch.zeros(2, 3), torch.tensor([1.0, 2.0]))
        >>> round(float(carried.sum()), 6)
        3.0
    """
    if volumes.shape != points.shape[:1]:
        raise ValueError(f"volumes must have shape ({len(points)},), got {tuple(volumes.shape)}")
    basis = SplineBasis(grid, points, torch.float64)
    carried = basis.scatter(volumes.double()[:, None]).flatten()
    nearest = basis.control_points()[1].flatten()
    return carried.new_zeros(grid.num_control_points).index_add(0, nearest, carried).reshape(grid.shape)


def cluster_control_points(grid: ControlPointGrid, weights: Tensor, num_groups: int) -> Tensor:
    """Group (0 to G - 1) of each control point, shape (nx, ny, nz), long.

    Starting from one group, the group with the largest extent along its principal direction is repeatedly cut in two
    across that direction, at the place that minimises the spread of the two parts about their centres (Otsu's
    criterion). Extents, directions and spreads are weighted. The cuts for g + 1 groups begin with those for g: groups
    are refined, and only the new group gets a new number. Control points far from the implant join the group of the
    nearest one that carries implant.

    Args:
        grid: Control points.
        weights: Implant volume that each CP carries (`control_point_volumes`), not negative, shape (nx, ny, nz).
        num_groups: G, at least 1.

    Raises:
        ValueError: If shapes do not fit, weights are negative or all zero, or there are fewer loaded CPs than groups.

    Example:
        >>> grid = ControlPointGrid((4, 4, 10), (10.0, 10.0, 20.0), torch.eye(4))
        >>> cluster_control_points(grid, torch.ones(grid.shape), 2)[0, 0].tolist()
        [0, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    """
    if weights.shape != grid.shape or not (weights >= 0).all() or not weights.sum() > 0:
        raise ValueError(f"weights must be of shape {grid.shape}, not negative, not all 0, got {tuple(weights.shape)}")
    weights = weights.detach().double().flatten()
    loaded = carrying(weights).nonzero().squeeze(-1)
    if not 1 <= num_groups <= len(loaded):
        raise ValueError(f"num_groups must be 1 to {len(loaded)}, the CPs that carry implant, got {num_groups}")
    all_positions = grid.positions().to(weights.device).reshape(-1, 3)
    positions, load = all_positions[loaded], weights[loaded]
    groups = torch.zeros_like(loaded)
    extents = [_principal_extent(positions, load)]
    for new in range(1, num_groups):
        # Rounded, so that equal halves of a symmetric implant are cut in the same order on all machines.
        widest = max(range(new), key=lambda group: round(extents[group], 6))
        members = (groups == widest).nonzero().squeeze(-1)
        groups[members[_upper_part(positions[members], load[members])]] = new
        extents.append(0.0)
        for part in (widest, new):
            extents[part] = _principal_extent(positions[groups == part], load[groups == part])
    return groups[torch.cdist(all_positions, positions).argmin(-1)].reshape(grid.shape)


def carrying(weights: Tensor) -> Tensor:
    """True for control points near the implant, in the shape of their weights; their number bounds that of groups."""
    return weights >= _LEAST_LOAD * weights.max()


def _principal_extent(positions: Tensor, load: Tensor) -> float:
    """Weighted standard deviation along the principal direction, mm; negative for a single point."""
    if len(positions) == 1:
        return -1.0
    return float(torch.linalg.eigvalsh(_covariance(positions, load))[-1].clamp(min=0).sqrt())


def _upper_part(positions: Tensor, load: Tensor) -> Tensor:
    """True for the points beyond the best cut across the principal direction; neither part is empty."""
    direction = torch.linalg.eigh(_covariance(positions, load)).eigenvectors[:, -1]
    direction = direction * torch.where(direction[direction.abs().argmax()] < 0, -1.0, 1.0)
    along = (positions - positions.mean(0)) @ direction
    order = along.argsort(stable=True)
    share = (load / load.sum())[order]
    below = share.cumsum(0)[:-1]
    moment = (share * along[order]).cumsum(0)
    # Between-class variance of a cut after each point, (mu w - m)^2 / (w (1 - w)).
    between = (moment[-1] * below - moment[:-1]).square() / (below * (1 - below)).clamp(min=1e-300)
    upper = torch.ones_like(order, dtype=torch.bool)
    upper[order[: int(between.argmax()) + 1]] = False
    return upper


def _covariance(positions: Tensor, load: Tensor) -> Tensor:
    share = (load / load.sum())[:, None]
    centered = positions - (share * positions).sum(0)
    return centered.T @ (share * centered)


def group_centers(grid: ControlPointGrid, labels: Tensor) -> Tensor:
    """Mean position (G, 3) of each group's control points in the grid's frame, mm, float64.

    Args:
        grid: Control points.
        labels: Group of each CP, (nx, ny, nz) long, with every group from 0 to G - 1.

    Raises:
        ValueError: If labels have another shape, are negative or leave a group out.
    """
    _check_labels(grid, labels)
    members = one_hot(labels.flatten()).T.double()
    count = members.sum(-1, keepdim=True)
    if not (count > 0).all():
        missing = (count[:, 0] == 0).nonzero().flatten().tolist()
        raise ValueError(f"labels must use every group from 0 to {len(count) - 1}, got none of {missing}")
    return members @ grid.positions().to(members).reshape(-1, 3) / count


def group_moments(
    grid: ControlPointGrid,
    labels: Tensor,
    points: Tensor,
    *,
    num_groups: int | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[Tensor, Tensor]:
    """Moments W (N, G) and M (N, G, 3) of the B-spline weights at each point, by group.

    W_g(x) = sum_{c in g} B_c(x) and M_g(x) = sum_{c in g} B_c(x) (c - c_g), mm, about the groups' centres, in the
    grid's axes. CPs beyond the grid belong to the group of the nearest CP of the grid. Both results are views of one
    (N, 4 G) tensor.

    Args:
        grid: Control points.
        labels: Group of each CP, (nx, ny, nz) long, with every group from 0 to G - 1.
        points: Points in the implant's frame, mm, shape (N, 3).
        num_groups: Number of groups G, checked if given.
        dtype: Dtype of the computation and the result; that of the points if not given.

    Raises:
        ValueError: If shapes or groups do not fit.

    Example:
        >>> grid = ControlPointGrid((4, 4, 4), (10.0, 10.0, 10.0), torch.eye(4))
        >>> one_group = torch.zeros(4, 4, 4, dtype=torch.long)
        >>> shares, moments = group_moments(grid, one_group, torch.tensor([[18.0, 12.0, 16.0]]))
        >>> shares.round(decimals=3).tolist(), moments.round(decimals=3).tolist()
        ([[1.0]], [[[3.0, -3.0, 1.0]]])
    """
    centers = group_centers(grid, labels)
    groups = len(centers)
    if num_groups is not None and num_groups != groups:
        raise ValueError(f"labels must hold {num_groups} groups, got {groups}")
    basis = SplineBasis(grid, points, dtype)
    moments = basis.evaluate(_cell_moments(grid, labels, basis, centers))
    return moments[:, :groups], moments[:, groups:].unflatten(-1, (groups, 3))


def group_moment_gradients(grid: ControlPointGrid, labels: Tensor, points: Tensor) -> Tensor:
    """Gradients (N, 3, G, 4) of the moments along the grid's axes: of W_g (1/mm), then of the three of M_g (1).

    Like the displacement, its gradient is linear in the groups' motions:
    d u / d x_j = sum_g t_g d_j W_g + (R_g - I) d_j M_g.

    Args:
        grid: Control points.
        labels: Group of each CP, (nx, ny, nz) long, with every group from 0 to G - 1.
        points: Points in the implant's frame, mm, shape (N, 3).
    """
    centers = group_centers(grid, labels)
    basis = SplineBasis(grid, points)
    features = _cell_moments(grid, labels, basis, centers)
    orders = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    slopes = torch.stack([basis.evaluate(features, o) / s for o, s in zip(orders, grid.spacing, strict=True)], dim=1)
    shares, moments = slopes.split([len(centers), 3 * len(centers)], dim=-1)
    return torch.cat([shares[..., None], moments.unflatten(-1, (-1, 3))], dim=-1)


def _cell_moments(grid: ControlPointGrid, labels: Tensor, basis: SplineBasis, centers: Tensor) -> Tensor:
    """Group membership and offset from the group centre of each cell's CPs, (num_cells, 64, 4 G); moments sum these."""
    indices, nearest = basis.control_points()
    member = one_hot(labels.to(indices.device).flatten()[nearest], len(centers)).double()
    spacing = torch.tensor(grid.spacing, dtype=torch.float64, device=indices.device)
    arms = (indices * spacing)[:, :, None] - centers.to(indices.device)
    return torch.cat([member, (member[..., None] * arms).flatten(-2)], dim=-1).to(basis.eta.dtype)


def moment_features(grid: ControlPointGrid, labels: Tensor, points: Tensor) -> Tensor:
    """Moments (N, 4 G), float64, of points (N, 3): per group W_g, then the three of M_g.

    Displacements in the grid's axes are `moment_features @ motion_coefficients`, for all candidates at once.
    """
    shares, moments = group_moments(grid, labels, points.double())
    return torch.cat([shares[..., None], moments], dim=-1).flatten(1)


def motion_coefficients(rotations: Tensor, translations: Tensor) -> Tensor:
    """Coefficients (..., 4 G, 3) of group motions for `moment_features`: t_g, then R_g - I, in the grid's axes.

    Args:
        rotations: Rotations of the groups about their centres, (..., G, 3, 3).
        translations: Translations of the groups' centres, mm, (..., G, 3).
    """
    turns = (rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).mT
    return torch.cat([translations[..., None, :], turns], dim=-2).flatten(-3, -2)


def control_points_from_groups(
    grid: ControlPointGrid, labels: Tensor, rotations: Tensor, translations: Tensor
) -> Tensor:
    """Control-point displacements phi (..., nx, ny, nz, 3), mm, of rigidly moving groups, in the grid's axes.

    phi_c = (R_g - I)(c - c_g) + t_g.

    Args:
        grid: Control points.
        labels: Group of each CP, (nx, ny, nz) long, with every group from 0 to G - 1.
        rotations: Rotations of the groups about their centres, (..., G, 3, 3).
        translations: Translations of the groups' centres, mm, (..., G, 3).
    """
    centers = group_centers(grid, labels).to(translations)
    _check_motions(rotations, translations, len(centers))
    group = labels.flatten()
    arms = grid.positions().to(translations).reshape(-1, 3) - centers[group]
    turns = (rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device))[..., group, :, :]
    phi = (turns @ arms[:, :, None]).squeeze(-1) + translations[..., group, :]
    return phi.unflatten(-2, grid.shape)


def _check_labels(grid: ControlPointGrid, labels: Tensor) -> None:
    if labels.shape != grid.shape or labels.is_floating_point():
        raise ValueError(f"labels must be integers of shape {grid.shape}, got {labels.dtype} {tuple(labels.shape)}")
    if int(labels.min()) < 0:
        raise ValueError(f"labels must not be negative, got {int(labels.min())}")


def _check_motions(rotations: Tensor, translations: Tensor, num_groups: int) -> None:
    if rotations.shape[-3:] != (num_groups, 3, 3) or translations.shape[-2:] != (num_groups, 3):
        raise ValueError(
            f"rotations and translations must be of {num_groups} groups, "
            f"got {tuple(rotations.shape)} and {tuple(translations.shape)}"
        )

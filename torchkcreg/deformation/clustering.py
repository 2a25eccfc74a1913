"""Which control points belong together: bisection along the implant."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.splines.basis import SplineBasis
from torchkcreg.splines.grid import ControlPointGrid

# A CP that carries less than this share of the most loaded one has no implant near it: it hardly moves a node, and
# must not attract cuts.
_LEAST_LOAD = 1e-3


def control_point_volumes(grid: ControlPointGrid, points: Tensor, volumes: Tensor) -> Tensor:
    """Implant volume that each control point carries, sum_n m_n B_c(x_n), mm^3, shape (nx, ny, nz), float64.

    They add up to the implant's volume; what a CP beyond the grid would carry counts to the nearest real one.

    Args:
        grid: control points.
        points: nodes in the implant's frame, mm, shape (N, 3).
        volumes: of the nodes, mm^3, shape (N,).

    Raises:
        ValueError: if shapes do not fit.

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

    From one group on, the group with the largest extent along its principal direction is cut in two across it, where
    the two parts' spread about their own centres is least (Otsu's criterion), until there are enough. Extents,
    directions and spreads are weighted. The cuts for g + 1 groups begin with those for g: groups are refined, and
    only the new one has a new number. Control points with no implant near join the nearest one that has.

    Args:
        grid: control points.
        weights: implant volume that each CP carries (`control_point_volumes`), not negative, shape (nx, ny, nz).
        num_groups: G, at least 1.

    Raises:
        ValueError: if shapes do not fit, weights are negative or all zero, or there are fewer loaded CPs than groups.

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
        # Rounded, so that equal halves of a symmetric implant are cut in the same order everywhere.
        widest = max(range(new), key=lambda group: round(extents[group], 6))
        members = (groups == widest).nonzero().squeeze(-1)
        groups[members[_upper_part(positions[members], load[members])]] = new
        extents.append(0.0)
        for part in (widest, new):
            extents[part] = _principal_extent(positions[groups == part], load[groups == part])
    return groups[torch.cdist(all_positions, positions).argmin(-1)].reshape(grid.shape)


def carrying(weights: Tensor) -> Tensor:
    """True for control points with implant near them, in the shape of their weights: as many as there can be groups."""
    return weights >= _LEAST_LOAD * weights.max()


def _principal_extent(positions: Tensor, load: Tensor) -> float:
    """Weighted standard deviation along the principal direction, mm; negative for a single point."""
    if len(positions) == 1:
        return -1.0
    return float(torch.linalg.eigvalsh(_covariance(positions, load))[-1].clamp(min=0).sqrt())


def _upper_part(positions: Tensor, load: Tensor) -> Tensor:
    """True for the points beyond the best cut across the principal direction; both parts hold some."""
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

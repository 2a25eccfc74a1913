"""Rotations on a grid over all orientations."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.geometry import rotation_from_vector, rotation_grid


@pytest.mark.parametrize("number", [500, 4608])
def test_no_rotation_is_far_from_the_grid(number: int) -> None:
    grid = rotation_grid(number)
    assert grid.shape == (number, 3, 3) and grid.dtype == torch.float64
    assert bool((torch.linalg.det(grid) > 0.999).all())
    any_rotation = rotation_from_vector(3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double())
    traces = torch.einsum("aij,bij->ab", any_rotation, grid).amax(1)
    degrees = torch.rad2deg(torch.acos(((traces - 1) / 2).clamp(-1, 1)))
    assert float(degrees.max()) < 230 / number ** (1 / 3)
    assert float(degrees.mean()) > 60 / number ** (1 / 3)


def test_a_grid_needs_a_rotation() -> None:
    with pytest.raises(ValueError, match="positive"):
        rotation_grid(0)

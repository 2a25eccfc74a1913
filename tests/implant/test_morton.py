from __future__ import annotations

import pytest
import torch

from torchkcreg.implant import morton_order


def test_a_full_cube_is_walked_octant_by_octant() -> None:
    lattice = torch.cartesian_prod(*[torch.arange(8.0)] * 3)
    shuffled = lattice[torch.randperm(512, generator=torch.Generator().manual_seed(0))]
    walked = shuffled[morton_order(shuffled, torch.eye(3))]
    assert walked[:8].tolist() == [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    for size in (2, 4):
        blocks = walked.reshape(-1, size**3, 3)
        assert (blocks.amax(1) - blocks.amin(1) == size - 1).all()


def test_consecutive_nodes_are_neighbours() -> None:
    plate = 0.25 * torch.cartesian_prod(torch.arange(20.0), torch.arange(50.0), torch.arange(300.0))
    shuffled = plate[torch.randperm(len(plate), generator=torch.Generator().manual_seed(0))]
    walked = shuffled[morton_order(shuffled, 0.25 * torch.eye(3))]
    assert walked.diff(dim=0).norm(dim=1).mean() < 2 * 0.25
    blocks = walked[: len(walked) // 4096 * 4096].reshape(-1, 4096, 3)
    assert (blocks.amax(1) - blocks.amin(1)).amax(1).median() < 12.0  # the plate is 75 mm long


def test_the_order_follows_a_slanted_lattice() -> None:
    indices = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    cell = torch.tensor([[0.3, 0.1, 0.0], [-0.1, 0.3, 0.05], [0.0, 0.0, 0.5]])
    order = morton_order(indices @ cell + 7.0, cell)
    assert torch.equal(order, morton_order(indices, torch.eye(3)))


def test_points_of_one_cell_keep_their_order() -> None:
    points = torch.zeros(5, 3) + 0.01 * torch.arange(5.0).flip(0)[:, None]
    assert morton_order(points, torch.eye(3)).tolist() == [0, 1, 2, 3, 4]


def test_points_too_far_apart_are_refused() -> None:
    with pytest.raises(ValueError, match="cells along each axis"):
        morton_order(torch.tensor([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]]), torch.eye(3))

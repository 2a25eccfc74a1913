from __future__ import annotations

import pytest
import torch
from drr_bodies import camera, lattice, rotation

from torchkcreg.projector import cell_footprint

PITCH = 0.25
CELL = PITCH * torch.eye(3, dtype=torch.float64)
ORIGIN = torch.zeros(1, 3, dtype=torch.float64)


def cell_edges_in_pixels(cell: torch.Tensor, pixel: float = 0.388) -> torch.Tensor:
    """At the origin of `camera(0)`: u runs along y, v along z, magnified by 538 / 404."""
    return cell[:, 1:] * (538 / 404) / pixel


def offsets(taps: int, phases: int) -> torch.Tensor:
    """Pixel minus node, (R + 1, T)."""
    phase = torch.arange(phases + 1, dtype=torch.float64) / phases
    return torch.arange(taps) - (taps // 2 - 1) - phase[:, None]


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("pitch", [0.02, 0.25, 1.0])
def test_taps_sum_to_one_at_every_phase(dtype, tolerance, pitch):
    cell = pitch * rotation((1, 2, 3), 40).to(dtype)
    table = cell_footprint(ORIGIN.to(dtype), cell, camera(10)).table
    assert table.dtype == dtype
    torch.testing.assert_close(table.sum((-1, -2)), torch.ones(1, 1, 17, 17, dtype=dtype), rtol=0, atol=tolerance)


def test_footprint_of_an_aligned_cell_is_a_product_of_trapezoids():
    footprint = cell_footprint(ORIGIN, CELL, camera(0), phases=32)
    edge = cell_edges_in_pixels(CELL)[1, 0]
    d = offsets(4, 32).abs()
    overlap = ((edge + 1) / 2 - d).clamp(0, float(min(edge, torch.tensor(1.0)))) / edge  # of cell and pixel
    expected = overlap[:, None, :, None] * overlap[None, :, None, :]
    # The corners of the trapezoid are rounded over 2 / R of a pixel.
    assert (footprint.table[0, 0] - expected).abs().max() < 0.02
    assert (footprint.table[0, 0] - expected).abs().mean() < 0.001


def test_second_moments_are_those_of_cell_and_pixel():
    cell = CELL @ rotation((3, 1, 2), 35)
    footprint = cell_footprint(ORIGIN, cell, camera(0))
    d = offsets(4, 16)[:16]  # phases 0 to 15/16 are a fine grid over the whole footprint
    table = footprint.table[0, 0, :16, :16] / 16**2
    second = [[torch.einsum("vuij,ui,vj->", table.mT, d**2, torch.ones_like(d))], []]
    second[0].append(torch.einsum("vuij,uj,vi->", table, d, d))
    second[1] = [second[0][1], torch.einsum("vuij,vi->", table, d**2)]
    edges = cell_edges_in_pixels(cell)
    expected = (edges.T @ edges + (1 + (2 / 16) ** 2) * torch.eye(2)) / 12
    torch.testing.assert_close(torch.tensor(second, dtype=torch.float64), expected, rtol=0, atol=5e-4)


def test_footprints_of_cells_that_fill_a_plane_add_up_to_one():
    footprint = cell_footprint(ORIGIN, CELL, camera(0), phases=16)
    edge = float(cell_edges_in_pixels(CELL)[1, 0])
    nodes = torch.arange(-20, 21) * edge  # along u, seen from the pixel at 0
    column = footprint.table[0, 0, 0].sum(-2)  # (R + 1, T): summed over rows
    position = -nodes - (-nodes).floor()
    # Pixel 0 is tap T/2 - 1 - floor(node) of the node.
    tap = 1 - nodes.floor().long()
    phase = (nodes - nodes.floor()) * 16
    assert position.min() >= 0
    lower = phase.long().clamp(max=15)
    inside = (tap >= 0) & (tap < 4)
    tap, lower, share = tap[inside], lower[inside], (phase - phase.long().clamp(max=15))[inside]
    total = ((1 - share) * column[lower, tap] + share * column[lower + 1, tap]).sum() * edge
    assert abs(float(total) - 1) < 3e-3


@pytest.mark.parametrize("pixel, taps", [(0.388, 4), (0.12, 6), (0.08, 8), (0.06, 12), (0.04, 16), (0.03, 24)])
def test_footprint_grows_where_cells_span_more_pixels(pixel, taps):
    cell = CELL @ rotation((1, 1, 1), 20)
    width = float(cell_edges_in_pixels(cell, pixel).abs().sum(0).max()) + 1 + 2 / 16
    footprint = cell_footprint(ORIGIN, cell, camera(0, pixel=pixel))
    assert footprint.taps == taps >= width
    beyond = offsets(taps, 16).abs() > width / 2
    beyond = beyond[:, None, :, None] | beyond[None, :, None, :]
    assert footprint.table[0, 0][beyond].abs().max() < 2e-3 * footprint.table.max()


def test_each_block_has_the_footprint_of_its_own_place():
    points = lattice((4, 4, 2.5))  # 2560 nodes
    whole = cell_footprint(points, CELL, camera(30), block_size=1000)
    assert whole.table.shape[:2] == (1, 3)
    assert (whole.num_blocks, whole.phases, whole.taps, whole.block_size) == (3, 16, 4, 1000)
    for block in range(3):
        alone = cell_footprint(points[1000 * block : 1000 * (block + 1)], CELL, camera(30), block_size=1000)
        torch.testing.assert_close(whole.table[:, block], alone.table[:, 0])


def test_each_block_may_have_its_own_cell():
    points = lattice((4, 4, 2.5))
    cells = torch.stack([CELL, CELL @ rotation((1, 0, 0), 30), 2 * CELL])
    whole = cell_footprint(points, cells, camera(30), block_size=1000)
    for block in range(3):
        alone = cell_footprint(points, cells[block], camera(30), block_size=1000)
        torch.testing.assert_close(whole.table[:, block], alone.table[:, block])


def test_candidates_share_the_footprint_of_their_mean():
    points = lattice((2, 2, 2))
    shift = torch.tensor([20.0, 0, 0], dtype=torch.float64)
    together = cell_footprint(torch.stack([points - shift, points + shift]), CELL, camera(30))
    torch.testing.assert_close(together.table, cell_footprint(points, CELL, camera(30)).table)


def test_blocks_out_of_sight_have_some_finite_footprint():
    points = torch.tensor([[0.0, 0, 0], [500.0, 0, 0], [float("nan"), 0, 0]])  # the source is at x = 404
    table = cell_footprint(points, CELL, camera(0), block_size=1).table
    assert table.isfinite().all()
    assert table.shape[-1] == 4


def test_footprint_carries_no_gradient():
    points = ORIGIN.clone().requires_grad_()
    assert not cell_footprint(points, CELL, camera(0).requires_grad_()).table.requires_grad


@pytest.mark.parametrize(
    "change, message",
    [
        ({"points": torch.zeros(5, 2)}, "points must have shape"),
        ({"points": torch.zeros(0, 3)}, "points must have shape"),
        ({"cell": torch.eye(2)}, "cell must have shape"),
        ({"cell": torch.eye(3) * float("nan")}, "cell must be finite"),
        ({"cell": torch.eye(3) * 25}, "at most 64 pixels"),
        ({"projection_matrices": torch.zeros(3, 4)}, "projection_matrices must have shape"),
        ({"block_size": 0}, "block_size must be positive"),
        ({"phases": 7}, "phases must be an even number"),
    ],
)
def test_wrong_input_is_named(change, message):
    arguments = {"points": ORIGIN, "cell": CELL, "projection_matrices": camera(0), **change}
    with pytest.raises(ValueError, match=message):
        cell_footprint(**arguments)

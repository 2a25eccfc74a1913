from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchkcreg.implant import fill_cells


def _rotation(seed: int) -> np.ndarray:
    return trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))


def test_a_box_fills_cells_by_the_product_of_its_overlaps() -> None:
    low, high = np.array([-1.3, 0.25, 2.0]), np.array([1.6, 3.5, 4.9])
    box = trimesh.creation.box(bounds=[low, high])
    cells = fill_cells(box.triangles)
    corner = cells.indices
    overlap_low, overlap_high = np.maximum(corner, low), np.minimum(corner + 1, high)
    np.testing.assert_allclose(cells.fractions, (overlap_high - overlap_low).prod(1), atol=1e-12)
    np.testing.assert_allclose(cells.centroids, (overlap_low + overlap_high) / 2 - corner, atol=1e-9)
    assert len(cells.fractions) == 4 * 4 * 3


def test_a_box_on_cell_faces_fills_whole_cells_and_no_others() -> None:
    cells = fill_cells(trimesh.creation.box(bounds=[[-2, 0, 1], [1, 2, 5]]).triangles)
    np.testing.assert_allclose(cells.fractions, np.ones(3 * 2 * 4), atol=1e-12)
    np.testing.assert_allclose(cells.centroids, 0.5, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.3, 8.0))
def test_volume_and_centre_of_any_solid_are_exact(seed: int, size: float) -> None:
    generator = np.random.default_rng(seed)
    solid = trimesh.convex.convex_hull(size * generator.normal(size=(20, 3)) + generator.normal(size=3) * 10)
    cells = fill_cells(solid.triangles)
    assert cells.fractions.sum() == pytest.approx(solid.volume, rel=1e-9, abs=1e-7)
    center = ((cells.indices + cells.centroids) * cells.fractions[:, None]).sum(0) / cells.fractions.sum()
    np.testing.assert_allclose(center, solid.center_mass, atol=1e-6)
    assert cells.fractions.min() > -1e-9 and cells.fractions.max() < 1 + 1e-9


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cells_of_a_ring_agree_with_dense_sampling(seed: int) -> None:
    ring = trimesh.creation.annulus(r_min=2.2, r_max=4.1, height=3.3)
    ring.apply_transform(_rotation(seed))
    cells = fill_cells(ring.triangles)
    generator = np.random.default_rng(0)
    chosen = generator.choice(len(cells.fractions), 8, replace=False)
    samples = generator.random((400, 3))
    inside = ring.contains((cells.indices[chosen, None] + samples).reshape(-1, 3)).reshape(8, 400)
    np.testing.assert_allclose(cells.fractions[chosen], inside.mean(1), atol=5 * 0.5 / np.sqrt(400))


def test_a_hollow_ball_is_empty_inside() -> None:
    outer, inner = trimesh.creation.icosphere(3, 6.0), trimesh.creation.icosphere(3, 4.0)
    inner.invert()
    cells = fill_cells(trimesh.util.concatenate([outer, inner]).triangles)
    radius = np.linalg.norm(cells.indices + 0.5, axis=1)
    assert radius.min() > 3.0
    assert cells.fractions.sum() == pytest.approx(outer.volume + inner.volume, rel=1e-12)


def test_large_and_small_triangles_fill_alike() -> None:
    box = trimesh.creation.box((7.3, 2.1, 3.7))
    box.apply_transform(_rotation(5))
    fine = box.subdivide().subdivide().subdivide()
    coarse_cells, fine_cells = fill_cells(box.triangles), fill_cells(fine.triangles)
    np.testing.assert_array_equal(coarse_cells.indices, fine_cells.indices)
    np.testing.assert_allclose(coarse_cells.fractions, fine_cells.fractions, atol=1e-11)


def test_an_implant_smaller_than_a_cell_fills_a_part_of_it() -> None:
    cells = fill_cells(trimesh.creation.icosphere(2, 0.1).triangles + 0.5)
    assert cells.indices.tolist() == [[0, 0, 0]]
    np.testing.assert_allclose(cells.centroids, 0.5, atol=1e-12)


def test_overlapping_solids_count_twice() -> None:
    boxes = trimesh.util.concatenate([trimesh.creation.box((2, 2, 2)), trimesh.creation.box((4, 4, 4))])
    assert fill_cells(boxes.triangles).fractions.max() == pytest.approx(2.0)

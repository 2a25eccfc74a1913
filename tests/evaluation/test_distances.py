import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist

from torchkcreg.evaluation import nearest_node_distances, nearest_node_floor, surface_distances
from torchkcreg.evaluation.distances import fills_volume, node_spacing, outermost_nodes
from torchkcreg.geometry import rigid_matrix, transform_points


def lattice(size, pitch=0.5):
    line = torch.arange(size, dtype=torch.float64) * pitch
    return torch.cartesian_prod(line, line, line)


def test_nearest_nodes_are_those_of_all_pairs():
    points, nodes = torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(0))
    expected = cdist(points.numpy(), nodes.numpy()).min(axis=1)
    assert nearest_node_distances(points, nodes).numpy() == pytest.approx(expected)


def test_lattices_turned_against_each_other_are_at_the_floor():
    turn = rigid_matrix(torch.tensor([0.3, 0.5, -0.4]).double(), torch.tensor([3.0, 2.5, 2.7]).double())
    inside = transform_points(turn, lattice(12, 0.25))  # well inside the other lattice
    nodes = lattice(50, 0.25) - 3
    distances = nearest_node_distances(inside, nodes)
    mean, rms = nearest_node_floor(0.25)
    assert distances.mean().item() == pytest.approx(mean, rel=0.02)
    assert distances.square().mean().sqrt().item() == pytest.approx(rms, rel=0.02)
    assert node_spacing(nodes) == pytest.approx(0.25)


def test_the_floor_is_that_of_random_places_in_a_cell():
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (400_000, 3))
    distances = np.linalg.norm(places, axis=1)
    assert nearest_node_floor(1.0) == pytest.approx((distances.mean(), np.sqrt((distances**2).mean())), rel=2e-3)


def test_distances_to_a_sphere_are_differences_of_radii():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    radii = torch.linspace(5, 15, 200)
    expected = (radii - 10).abs().double()
    torch.testing.assert_close(surface_distances(radii[:, None] * directions, sphere), expected, rtol=0, atol=6e-3)


def test_nodes_of_a_body_and_scans_of_its_surface_are_told_apart():
    plate = trimesh.creation.box((10.0, 2.0, 40.0))
    line_x, line_y, line_z = (torch.arange(0.125, size, 0.25) for size in (10.0, 2.0, 40.0))
    scan = torch.tensor(np.asarray(trimesh.sample.sample_surface(plate, 20_000, seed=0)[0]))
    assert fills_volume(torch.cartesian_prod(line_x, line_y, line_z))
    assert not fills_volume(scan)
    assert not fills_volume(scan + 0.02 * torch.randn(scan.shape, generator=torch.Generator().manual_seed(0)))


def test_the_outermost_nodes_of_a_cube_are_its_shell():
    found = {tuple(node) for node in outermost_nodes(lattice(7)).tolist()}
    shell = {tuple(n) for n in lattice(7).tolist() if min(n) == 0 or max(n) == 3}
    assert found == shell


def test_clouds_that_cannot_be_measured_are_refused():
    good = torch.zeros(2, 3)
    with pytest.raises(ValueError, match=r"points must have shape \(N, 3\) with N > 0, got \(0, 3\)"):
        nearest_node_distances(torch.zeros(0, 3), good)
    with pytest.raises(ValueError, match="nodes must be finite, but row 1 is not"):
        nearest_node_distances(good, torch.tensor([[0.0, 0, 0], [0, float("nan"), 0]]))
    with pytest.raises(ValueError, match="pitch_mm must be a positive length"):
        nearest_node_floor(0.0)
    with pytest.raises(ValueError, match="mesh must have faces"):
        surface_distances(good, trimesh.Trimesh())
    with pytest.raises(ValueError, match="at least two different points"):
        node_spacing(good)

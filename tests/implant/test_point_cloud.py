from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.geometry import VolumeGrid, rotation_from_vector, transform_points
from torchkcreg.implant import ImplantPointCloud

_TURN = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, -0.5], [3.0, -2.0, 5.0])


def _solids() -> dict[str, trimesh.Trimesh]:
    plate = trimesh.creation.box((4.6, 13.5, 40.0))
    return {
        "box": plate,
        "turned box": plate.copy().apply_transform(_TURN),
        "ball": trimesh.creation.icosphere(4, 5.0),
        "capsule": trimesh.creation.capsule(height=20.0, radius=2.0, count=[32, 32]),
        "washer": trimesh.creation.annulus(r_min=2.5, r_max=6.0, height=4.6).apply_transform(_TURN),
    }


@pytest.mark.parametrize("name", _solids())
@pytest.mark.parametrize("at_centroids", [False, True])
def test_volumes_add_up_to_the_volume_and_balance_at_its_centre(name: str, at_centroids: bool) -> None:
    mesh = _solids()[name]
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5, at_centroids=at_centroids, dtype=torch.float64)
    assert cloud.volume == pytest.approx(mesh.volume, rel=1e-7)
    center = (cloud.volumes[:, None] * cloud.points).sum(0) / cloud.volumes.sum()
    tolerance = 1e-4 if at_centroids else 0.02
    np.testing.assert_allclose(center.numpy(), mesh.center_mass, atol=tolerance)


def test_the_moments_of_a_ball_are_those_of_the_ball() -> None:
    mesh = trimesh.creation.icosphere(5, 5.0)
    cloud = ImplantPointCloud.from_mesh(mesh, 0.25, at_centroids=True, dtype=torch.float64)
    second = (cloud.volumes[:, None, None] * cloud.points[:, :, None] * cloud.points[:, None]).sum(0) / cloud.volume
    expected = torch.eye(3, dtype=torch.float64) * 25.0 / 5
    torch.testing.assert_close(second, expected, rtol=5e-3, atol=1e-3)
    assert cloud.volume == pytest.approx(4 / 3 * math.pi * 125, rel=2e-3)


def test_nodes_stand_at_the_centres_of_lattice_cells() -> None:
    corner, box = (0.1, 0.2, 0.3), _solids()["turned box"]
    cloud = ImplantPointCloud.from_mesh(box, 0.4, origin=corner, at_centroids=False, dtype=torch.float64)
    in_cells = (cloud.points - torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)) / 0.4
    torch.testing.assert_close(in_cells - in_cells.floor(), torch.full_like(in_cells, 0.5), rtol=0, atol=1e-9)
    assert torch.equal(cloud.cell, 0.4 * torch.eye(3, dtype=torch.float64))
    assert cloud.volumes.max().item() == pytest.approx(0.4**3)
    assert len(cloud.points.unique(dim=0)) == cloud.num_nodes


def test_a_box_between_lattice_planes_has_its_partial_volumes_at_the_faces() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((1.2, 2.0, 3.0)), 0.5, dtype=torch.float64)
    outer = cloud.points[:, 0].abs() > 0.5
    expected = torch.where(outer, 0.125 * 0.2, 0.125).double()
    torch.testing.assert_close(cloud.volumes, expected)


def test_buffers_are_single_precision_by_default_and_follow_casts() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((2, 2, 2)), 0.5)
    assert {buffer.dtype for buffer in cloud.buffers()} == {torch.float32}
    assert {buffer.dtype for buffer in cloud.double().buffers()} == {torch.float64}
    assert not list(cloud.parameters())


def test_a_cloud_reloads_from_its_state() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((2, 2, 2)), 0.5)
    other = ImplantPointCloud(torch.zeros_like(cloud.points), torch.ones_like(cloud.volumes), torch.eye(3))
    other.load_state_dict(cloud.state_dict())
    assert torch.equal(other.points, cloud.points) and torch.equal(other.cell, cloud.cell)
    assert repr(cloud) == "ImplantPointCloud(num_nodes=64, volume=8 mm^3, cell=0.5 x 0.5 x 0.5 mm)"


def test_nodes_are_stored_as_neighbours_whatever_order_they_come_in() -> None:
    cloud = ImplantPointCloud.from_mesh(_solids()["turned box"], 0.5, at_centroids=False)
    shuffle = torch.randperm(cloud.num_nodes, generator=torch.Generator().manual_seed(0))
    again = ImplantPointCloud(cloud.points[shuffle], cloud.volumes[shuffle], cloud.cell)
    assert torch.equal(again.points, cloud.points) and torch.equal(again.volumes, cloud.volumes)
    assert cloud.points.diff(dim=0).norm(dim=1).mean() < 2 * 0.5


@pytest.mark.parametrize("factor", [1, 2, 3, 50])
def test_coarsening_keeps_mass_and_centre(factor: int) -> None:
    cloud = ImplantPointCloud.from_mesh(_solids()["washer"], 0.5, dtype=torch.float64)
    coarse = cloud.coarsened(factor)
    assert coarse.volume == pytest.approx(cloud.volume, rel=1e-12)
    centers = [(c.volumes[:, None] * c.points).sum(0) / c.volume for c in (cloud, coarse)]
    torch.testing.assert_close(*centers, rtol=0, atol=1e-9)
    assert torch.equal(coarse.cell, factor * cloud.cell)
    assert (coarse.volumes <= torch.linalg.det(coarse.cell) * (1 + 1e-9)).all()
    if factor == 1:
        torch.testing.assert_close(coarse.points, cloud.points)
    if factor == 50:
        assert coarse.num_nodes == 1


def test_inside_a_solid_coarse_nodes_form_a_coarse_lattice() -> None:
    coarse = ImplantPointCloud.from_mesh(trimesh.creation.box((4, 4, 4)), 0.25).coarsened(4)
    assert coarse.num_nodes == 64
    torch.testing.assert_close(coarse.volumes, torch.ones(64))
    torch.testing.assert_close(coarse.points - coarse.points.floor(), torch.full((64, 3), 0.5))


def test_principal_axes_of_a_turned_box_are_its_edges() -> None:
    cloud = ImplantPointCloud.from_mesh(_solids()["turned box"], 0.4, at_centroids=True, dtype=torch.float64)
    center, axes, extents = cloud.principal_axes()
    expected_center = _TURN[:3, 3]
    np.testing.assert_allclose(center.numpy(), expected_center, atol=1e-4)
    overlap = axes.numpy() @ _TURN[:3, :3]
    np.testing.assert_allclose(np.abs(overlap), np.eye(3), atol=1e-2)
    assert torch.linalg.det(axes).item() == pytest.approx(1.0)
    for row in axes[1:]:
        assert row[row.abs().argmax()] > 0
    np.testing.assert_allclose(extents.numpy(), [4.6, 13.5, 40.0], atol=0.8)


def test_a_volume_gives_one_node_a_voxel_above_the_threshold() -> None:
    direction = rotation_from_vector(torch.tensor([0.2, 0.3, -0.4], dtype=torch.float64))
    grid = VolumeGrid((3, 4, 5), (0.5, 1.0, 2.0), (1.0, 2.0, 3.0), direction)
    volume = torch.zeros(grid.shape)
    volume[1, 2, 3], volume[2, 0, 4], volume[0, 0, 0] = 3.0, 0.9, 0.2
    cloud = ImplantPointCloud.from_volume(volume, grid, threshold=0.3, metal_value=1.8, dtype=torch.float64)
    world = grid.points(dtype=torch.float64)
    expected = {(1, 2, 3): 1.0, (2, 0, 4): 0.5}
    assert cloud.num_nodes == 2
    for index, volume in expected.items():
        nearest = (cloud.points - world[index]).norm(dim=1).argmin()
        torch.testing.assert_close(cloud.points[nearest], world[index])
        assert cloud.volumes[nearest].item() == pytest.approx(volume)
    corner = transform_points(grid.voxel_to_world, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(cloud.cell, corner - world[0, 0, 0])


def test_a_volume_of_partial_fractions_keeps_the_implants_volume() -> None:
    mesh = _solids()["turned box"]
    exact = ImplantPointCloud.from_mesh(mesh, 0.5, dtype=torch.float64)
    grid = VolumeGrid((120, 120, 120), 0.5, (-24.75, -24.75, -24.75))
    volume = torch.zeros(grid.shape, dtype=torch.float64)
    i, j, k = ((exact.points + 24.75) / 0.5).round().long().unbind(1)
    volume[k, j, i] = 2.5 * exact.volumes / 0.125
    cloud = ImplantPointCloud.from_volume(volume, grid, threshold=0.001, metal_value=2.5, dtype=torch.float64)
    assert cloud.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_an_inverted_mesh_gives_the_same_cloud() -> None:
    mesh = trimesh.creation.icosphere(3, 3.0)
    expected = ImplantPointCloud.from_mesh(mesh, 0.5)
    mesh.invert()
    torch.testing.assert_close(ImplantPointCloud.from_mesh(mesh, 0.5).volumes, expected.volumes)


def test_meshes_that_are_no_solid_are_refused() -> None:
    opened = trimesh.creation.box((2, 2, 2))
    opened.update_faces(np.arange(12) != 0)
    with pytest.raises(ValueError, match="3 open edges"):
        ImplantPointCloud.from_mesh(opened)
    twice = trimesh.util.concatenate([trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1, 1, 1))])
    with pytest.raises(ValueError, match="overlap"):
        ImplantPointCloud.from_mesh(twice)
    for pitch in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="pitch"):
            ImplantPointCloud.from_mesh(trimesh.creation.box((2, 2, 2)), pitch)


@pytest.mark.parametrize(
    ("points", "volumes", "cell", "message"),
    [
        (torch.zeros(0, 3), torch.zeros(0), torch.eye(3), "points"),
        (torch.zeros(4, 2), torch.zeros(4), torch.eye(3), "points"),
        (torch.full((4, 3), torch.inf), torch.zeros(4), torch.eye(3), "points"),
        (torch.zeros(4, 3, dtype=torch.int64), torch.zeros(4), torch.eye(3), "points"),
        (torch.zeros(4, 3), torch.zeros(3), torch.eye(3), "volumes"),
        (torch.zeros(4, 3), -torch.ones(4), torch.eye(3), "volumes"),
        (torch.zeros(4, 3), torch.ones(4), torch.eye(2), "cell"),
        (torch.zeros(4, 3), torch.ones(4), torch.zeros(3, 3), "cell"),
    ],
)
def test_what_is_no_cloud_is_refused(
    points: torch.Tensor, volumes: torch.Tensor, cell: torch.Tensor, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ImplantPointCloud(points, volumes, cell)


def test_volumes_without_metal_and_impossible_thresholds_are_refused() -> None:
    grid = VolumeGrid((2, 2, 2))
    for volume, threshold, metal in (
        (torch.zeros(2, 2, 2), 0.5, 1.0),
        (torch.ones(2, 2, 2), 1.0, 1.0),
        (torch.ones(2, 2, 2), -0.1, 1.0),
        (torch.ones(2, 2, 3), 0.5, 1.0),
    ):
        with pytest.raises(ValueError):
            ImplantPointCloud.from_volume(volume, grid, threshold=threshold, metal_value=metal)
    with pytest.raises(ValueError, match="factor"):
        ImplantPointCloud.from_mesh(trimesh.creation.box((2, 2, 2)), 0.5).coarsened(0)


def test_a_coarsened_cloud_is_made_once_and_again_when_the_nodes_change() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((4.0, 4.0, 8.0)), pitch=0.5)
    coarse = cloud.coarsened(2)
    assert cloud.coarsened(2) is coarse and cloud.coarsened(4) is not coarse
    with torch.no_grad():
        cloud.volumes.mul_(0.5)
    assert cloud.coarsened(2).volume == pytest.approx(coarse.volume / 2)
    assert cloud.double().coarsened(2).points.dtype == torch.float64


def test_a_cloud_made_in_inference_mode_coarsens_too() -> None:
    with torch.inference_mode():
        cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((4.0, 4.0, 8.0)), pitch=0.5)
    assert cloud.coarsened(2).volume == pytest.approx(cloud.volume)


def test_a_mapped_cloud_is_that_of_the_mapped_mesh_in_the_same_order() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((2.0, 3.0, 10.0)), pitch=0.5)
    linear = torch.tensor([[1.0, 0.1, 0.0], [0.0, 2.0, 0.0], [0.3, 0.0, 0.5]])
    shift = torch.tensor([4.0, 5.0, 6.0])
    mapped = cloud.mapped(linear, shift)
    torch.testing.assert_close(mapped.points, cloud.points @ linear + shift)
    torch.testing.assert_close(mapped.cell, cloud.cell @ linear)
    assert mapped.volume == pytest.approx(cloud.volume * float(torch.linalg.det(linear)), rel=1e-5)
    assert torch.equal(cloud.points, ImplantPointCloud.from_mesh(trimesh.creation.box((2.0, 3.0, 10.0)), 0.5).points)

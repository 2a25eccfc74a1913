from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from drr_bodies import box_chords, camera, lattice, nearby, rays, rotation

from torchkcreg.projector import PointCloudProjector, cell_footprint, project_points

PITCH = 0.25
CELL = PITCH * torch.eye(3, dtype=torch.float64)
SHAPE = (96, 96)


def volumes_of(points: torch.Tensor, pitch: float = PITCH) -> torch.Tensor:
    return torch.full((points.shape[-2],), pitch**3, dtype=points.dtype)


def box_drr(size, turn, *, dtype=torch.float32, block_size=8192, **camera_options):
    """DRR of a box that is turned with its lattice, and the chord through each pixel's centre."""
    matrices = camera(det_shape=SHAPE, **camera_options)
    points = (lattice(size) @ turn.T).to(dtype)
    footprint = cell_footprint(points, CELL @ turn.T, matrices, block_size=block_size)
    image = project_points(points, volumes_of(points), matrices, SHAPE, footprint=footprint)[0].double()
    source, directions = rays(matrices[0], SHAPE)
    return image, box_chords(source @ turn, directions @ turn, size), matrices


def interior_of_slab(size, turn, matrix):
    """Pixels whose rays, and those two pixels around, pass the two large faces (normal to x in the slab's axes)."""
    inside = torch.ones(SHAPE, dtype=torch.bool)
    half = torch.tensor(size, dtype=torch.float64) / 2
    for shift in ((-2.0, -2.0), (-2.0, 2.0), (2.0, -2.0), (2.0, 2.0)):
        source, directions = rays(matrix, SHAPE, shift)
        source, directions = source @ turn, directions @ turn
        for face in (-half[0], half[0]):
            hit = source + ((face - source[0]) / directions[..., :1]) * directions
            inside &= (hit[..., 1:].abs() < half[1:]).all(-1)
    return inside


@pytest.mark.parametrize(
    "tilt_axis, tilt", [((0, 0, 1), 0.0), ((0, 0, 1), 25.0), ((0, 1, 0), 40.0), ((0, 1, 1), 55.0), ((0, 2, -1), 10.0)]
)
@pytest.mark.parametrize("in_plane", [0.0, 3.0, 15.0, 22.5, 37.0, 45.0])
@pytest.mark.parametrize("thickness", [1.0, 3.0])
def test_a_slab_has_its_path_length_and_no_stripes(thickness, in_plane, tilt_axis, tilt):
    turn = rotation(tilt_axis, tilt) @ rotation((1, 0, 0), in_plane)
    size = (thickness, 20.0, 20.0)
    image, chords, matrices = box_drr(size, turn)
    ratio = (image / chords)[interior_of_slab(size, turn, matrices[0])]
    assert len(ratio) > 500
    assert ratio.std() < 0.0015
    assert abs(ratio.mean() - 1) < 1e-4


def test_a_single_layer_of_nodes_has_no_stripes_with_blocks_of_its_size():
    turn = rotation((0, 0, 1), 30) @ rotation((1, 0, 0), 12)
    size = (PITCH, 20.0, 20.0)
    image, chords, matrices = box_drr(size, turn, block_size=2048)
    ratio = (image / chords)[interior_of_slab(size, turn, matrices[0])]
    assert ratio.std() < 0.003


def test_stripes_stay_away_while_a_footprint_is_reused_for_poses_a_few_degrees_off():
    turn, size = rotation((0, 1, 1), 30), (3.0, 20.0, 20.0)
    matrices = camera(det_shape=SHAPE)
    points = lattice(size)
    footprint = cell_footprint(points @ turn.T, CELL @ turn.T, matrices)
    turn = rotation((1, -1, 2), 4) @ turn
    image = project_points(points @ turn.T, volumes_of(points), matrices, SHAPE, footprint=footprint)[0]
    source, directions = rays(matrices[0], SHAPE)
    chords = box_chords(source @ turn, directions @ turn, size)
    assert (image / chords)[interior_of_slab(size, turn, matrices[0])].std() < 0.003


@pytest.mark.parametrize("source_z, angle", [(0.0, 0.0), (120.0, 91.0), (-120.0, 48.0)])
def test_a_turned_box_has_its_chords(source_z, angle):
    size, turn = (4.0, 10.0, 14.0), rotation((1, 2, 3), 33)
    image, chords, _ = box_drr(size, turn, source_z=source_z, angle_deg=angle)
    # A chord bends where a ray meets an edge, and only there the mean over a pixel differs from the middle's.
    bend = torch.nn.functional.pad(chords, (2, 2, 2, 2)).unfold(0, 5, 1).unfold(1, 5, 1)
    smooth = (bend.mean((-1, -2)) - chords).abs() < 0.01
    assert (smooth & (chords > 1)).sum() > 50
    assert (image - chords)[smooth & (chords > 1)].abs().max() < 0.03
    assert image[~nearby(chords > 0, 2)].abs().max() < 1e-4


def test_a_sphere_with_partial_volumes_has_its_chords():
    radius, matrices = 5.0, camera(20, det_shape=SHAPE, source_z=60.0)
    points = lattice((10.5, 10.5, 10.5))
    sub = (torch.arange(5, dtype=torch.float64) - 2) / 5 * PITCH
    inside = ((points[:, None] + torch.cartesian_prod(sub, sub, sub)).norm(dim=-1) < radius).double().mean(1)
    kept = inside > 0
    points, volumes = points[kept], inside[kept] * PITCH**3
    image = project_points(points, volumes, matrices, SHAPE, cell=CELL)[0]
    source, directions = rays(matrices[0], SHAPE)
    distance = torch.linalg.cross(directions, (-source).expand_as(directions)).norm(dim=-1)
    chords = 2 * (radius**2 - distance**2).clamp(min=0).sqrt()
    inner = distance < 0.85 * radius
    assert ((image - chords)[inner] / chords[inner]).std() < 0.005
    assert abs(float(image[inner].sum() / chords[inner].sum()) - 1) < 0.002
    assert image[distance > radius + 1].abs().max() < 1e-4


@pytest.mark.parametrize("backend", ["cpp", "torch"])
def test_no_mass_is_lost(backend):
    matrices = camera(33, det_shape=SHAPE, source_z=-70.0)
    points = lattice((3, 3, 3)) @ rotation((1, 2, 0), 20).T
    volumes = torch.rand(len(points), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    image = project_points(points, volumes, matrices, SHAPE, cell=CELL, backend=backend)[0]
    linear = matrices[0, :, :3]
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SHAPE), indexing="ij")
    ray = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ torch.linalg.inv(linear).T
    depth = points @ matrices[0, 2, :3] + matrices[0, 2, 3]
    total = (image / (linear.det().abs() * ray.norm(dim=-1))).sum()
    torch.testing.assert_close(total, (volumes / depth**2).sum(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("backend", ["cpp", "torch"])
def test_a_footprint_that_leaves_the_detector_loses_just_that_part(backend):
    points = lattice((2, 12, 12)) @ rotation((1, 2, 3), 25).T
    row, col = 370, 375  # the body covers pixels around (383, 383) of the large detector
    options = {"cell": CELL, "backend": backend}
    large = project_points(points, volumes_of(points), camera(10, first_pixel=(340, 340)), (90, 90), **options)
    small = project_points(points, volumes_of(points), camera(10, first_pixel=(row, col)), (15, 20), **options)
    expected = large[:, row - 340 : row - 325, col - 340 : col - 320]
    assert (expected[0, 0] > 1).any() and (expected[0, :, 0] > 1).any() and (expected[0, -1] > 1).any()
    torch.testing.assert_close(small, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("backend", ["cpp", "torch"])
@pytest.mark.parametrize(
    "stray",
    [(500.0, 0.0, 0.0), (404.0, 0.0, 0.0), (float("nan"), 0, 0), (0, float("inf"), 0), (0, 0, 1e30), (0.0, 400.0, 0.0)],
    ids=["behind the source", "in the source", "nan", "infinite", "far off", "beside"],
)
def test_a_node_that_cannot_be_seen_changes_nothing(stray, backend):
    points = lattice((2, 2, 2))
    footprint = cell_footprint(points, CELL, camera(0))
    alone = project_points(points, volumes_of(points), camera(0), (64, 64), footprint=footprint, backend=backend)
    with_stray = torch.cat([points, torch.tensor([stray], dtype=torch.float64)]).requires_grad_()
    image = project_points(
        with_stray, volumes_of(with_stray), camera(0), (64, 64), footprint=footprint, backend=backend
    )
    torch.testing.assert_close(image, alone, rtol=1e-12, atol=1e-12)
    image.square().sum().backward()
    assert with_stray.grad.isfinite().all()
    assert (with_stray.grad[-1] == 0).all()
    assert (with_stray.grad[:-1] != 0).any()


def test_moving_the_implant_is_moving_the_gantry_back():
    points = lattice((3, 5, 7))
    turn, shift = rotation((1, 2, 3), 25), torch.tensor([3.0, -2, 5], dtype=torch.float64)
    matrices = torch.cat([camera(20, det_shape=SHAPE), camera(100, det_shape=SHAPE, source_z=120.0)])
    moved_points = project_points(points @ turn.T + shift, volumes_of(points), matrices, SHAPE, cell=CELL @ turn.T)
    rigid = torch.eye(4, dtype=torch.float64)
    rigid[:3, :3], rigid[:3, 3] = turn, shift
    moved_gantry = project_points(points, volumes_of(points), matrices @ rigid, SHAPE, cell=CELL)
    assert moved_points.max() > 2
    torch.testing.assert_close(moved_points, moved_gantry, rtol=1e-9, atol=1e-9)


def test_mirrored_and_rescaled_matrices_describe_their_own_images():
    points = lattice((3, 5, 7)) + 1.5
    matrices = camera(20, det_shape=SHAPE)
    flip = torch.tensor([[-1.0, 0, SHAPE[1] - 1], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    image = project_points(points, volumes_of(points), matrices, SHAPE, cell=CELL)
    mirrored = project_points(points, volumes_of(points), flip @ matrices, SHAPE, cell=CELL)
    torch.testing.assert_close(mirrored, image.flip(-1), rtol=1e-9, atol=1e-9)


def test_candidates_are_projected_each_by_itself():
    points = lattice((2, 3, 4))
    shifts = torch.randn(2, 3, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    matrices = torch.cat([camera(20), camera(50, source_z=120.0)])
    footprint = cell_footprint(points, CELL, matrices)
    images = project_points(points + shifts, volumes_of(points), matrices, (64, 64), footprint=footprint)
    assert images.shape == (2, 3, 2, 64, 64)
    for i in range(2):
        for j in range(3):
            alone = project_points(points + shifts[i, j], volumes_of(points), matrices, (64, 64), footprint=footprint)
            assert torch.equal(images[i, j], alone)


@pytest.mark.parametrize("matrix_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_images_have_the_dtype_of_the_points(dtype, matrix_dtype):
    points = lattice((2, 3, 4))
    exact = project_points(points, volumes_of(points), camera(20), (64, 64), cell=CELL)
    image = project_points(points.to(dtype), volumes_of(points), camera(20).to(matrix_dtype), (64, 64), cell=CELL)
    assert image.dtype == dtype
    torch.testing.assert_close(image.double(), exact, rtol=0, atol=2e-3)


def test_projector_module_takes_any_geometry():
    points = lattice((2, 3, 4))
    geometry = SimpleNamespace(projection_matrices=camera(20), det_shape=(64, 64))
    projector = PointCloudProjector(geometry, backend="torch")
    expected = project_points(points, volumes_of(points), camera(20), (64, 64), cell=CELL, backend="torch")
    assert torch.equal(projector(points, volumes_of(points), cell=CELL), expected)
    footprint = cell_footprint(points, CELL, camera(20))
    assert torch.equal(projector(points, volumes_of(points), footprint=footprint), expected)
    assert "torch" in repr(projector)


def test_a_geometry_module_moves_with_the_projector():
    geometry = torch.nn.Module()
    geometry.register_buffer("projection_matrices", camera(20))
    geometry.det_shape = (64, 64)
    projector = PointCloudProjector(geometry)
    assert "geometry.projection_matrices" in projector.state_dict()
    assert projector.to(torch.float32).geometry.projection_matrices.dtype == torch.float32


POINTS = torch.zeros(4, 3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"points": torch.zeros(4, 2)}, r"points must have shape \(\.\.\., N, 3\)"),
        ({"points": torch.zeros(4, 3, dtype=torch.int64)}, "points must be float32 or float64"),
        ({"points": torch.zeros(4, 3, dtype=torch.float16)}, "points must be float32 or float64"),
        ({"volumes": torch.ones(5)}, r"volumes must have shape \(4,\)"),
        ({"volumes": torch.ones(4, dtype=torch.int32)}, "volumes must be floating point"),
        ({"volumes": torch.ones(4, device="meta")}, "volumes must be on the points' device"),
        ({"projection_matrices": torch.zeros(3, 4)}, r"projection_matrices must have shape \(V, 3, 4\)"),
        ({"det_shape": (0, 5)}, "det_shape must be"),
        ({"cell": None}, "either cell or footprint"),
        ({"footprint": cell_footprint(POINTS, CELL, camera(0))}, "either cell or footprint"),
        ({"cell": None, "footprint": cell_footprint(POINTS, CELL, camera(0), block_size=2)}, "3 views and 1 blocks"),
        ({"backend": "fast"}, "backend must be one of auto, cpp, triton, torch"),
        ({"backend": "triton"}, 'backend "triton" needs tensors on cuda, got cpu'),
    ],
)
def test_wrong_input_is_named(change, message):
    arguments = {
        "points": POINTS,
        "volumes": torch.ones(4),
        "projection_matrices": camera(0),
        "det_shape": (8, 8),
        "cell": CELL,
        **change,
    }
    if "1 blocks" in message:
        arguments["projection_matrices"] = camera(0).expand(3, 3, 4)
        message = "footprint must have 3 views and 1 blocks"
        arguments["footprint"] = cell_footprint(POINTS, CELL, camera(0))
    with pytest.raises(ValueError, match=message):
        project_points(**arguments)


def test_a_matrix_of_the_wrong_sign_is_refused() -> None:
    matrix = torch.tensor([[1000.0, 0, 32, 16000], [0, 1000, 32, 16000], [0, 0, 1, 500]])
    points, volumes = torch.zeros(1, 3), torch.ones(1)
    with pytest.raises(ValueError, match="behind the source of view 1"):
        project_points(points, volumes, torch.stack([matrix, -matrix]), (65, 65), cell=torch.eye(3))

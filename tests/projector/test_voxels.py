from __future__ import annotations

import pytest
import torch
from drr_bodies import box_chords, camera, rays, rotation
from voxel_scenes import (
    DET_SHAPE,
    KINDS,
    PIXEL,
    ellipsoid_chords,
    ellipsoid_volume,
    skew_grid,
    straight_grid,
    tilted,
    views,
)

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, circular_geometry
from torchkcreg.projector import VolumeProjector, backproject, backproject_weighted, project_volume

BACKENDS = ("torch", "auto")


def relative_rms(values: torch.Tensor, truth: torch.Tensor) -> float:
    return float((values - truth).norm() / truth.norm())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
def test_a_ray_through_opposite_faces_of_a_full_grid_measures_its_chord(kind, turned, backend):
    turn = rotation((1, 2, 3), 20) if turned else torch.eye(3, dtype=torch.float64)
    grid = VolumeGrid.centered((24, 24, 24), (2.0, 2.0, 2.0), direction=turn.tolist())
    images = project_volume(torch.ones(grid.shape, dtype=torch.float64), grid, views(kind), DET_SHAPE, backend=backend)
    crossed = 0
    for image, matrix in zip(images, views(kind)):
        source, directions = rays(matrix, DET_SHAPE)
        source, directions = source @ turn, directions @ turn
        chord = box_chords(source, directions, (48.0, 48.0, 48.0))
        # Joseph's ray is exact where it passes the two faces of its major axis a voxel or more from their edges.
        major = directions.abs().argmax(-1, keepdim=True)
        clear = torch.ones(DET_SHAPE, dtype=torch.bool)
        for face in (-24.0, 24.0):
            step = (face - source[major]) / directions.gather(-1, major)
            hit = (source + step * directions).scatter(-1, major, 0.0)
            clear &= hit.abs().amax(-1) < 22
        crossed += int(clear.sum())
        torch.testing.assert_close(image[clear], chord[clear], rtol=1e-9, atol=1e-9)
    assert crossed > 50


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("grid_of", [straight_grid, skew_grid])
def test_an_ellipsoid_has_its_analytic_chords(kind, grid_of):
    grid = grid_of((40, 40, 40))
    center, axes = torch.tensor([4.0, -3.0, 2.0]), torch.tensor([22.0, 15.0, 18.0])
    volume = ellipsoid_volume(grid, center, axes)
    truth = ellipsoid_chords(views(kind), DET_SHAPE, center, axes)
    assert (truth.amax((1, 2)) > 20).all()
    images = project_volume(volume, grid, views(kind), DET_SHAPE)
    assert relative_rms(images, truth) < 0.05  # voxels blur the rim
    deep = truth > 0.6 * truth.max()
    assert relative_rms(images[deep], truth[deep]) < 0.01
    assert abs(float(images.sum() / truth.sum()) - 1) < 3e-3


def test_finer_voxels_come_nearer_to_the_chords():
    center, axes = torch.tensor([2.0, -3.0, 1.0]), torch.tensor([14.0, 10.0, 12.0])
    truth = ellipsoid_chords(views("tilted"), DET_SHAPE, center, axes)
    errors = []
    for count, spacing in ((8, 4.0), (16, 2.0), (32, 1.0)):
        grid = VolumeGrid.centered((count,) * 3, spacing)
        images = project_volume(ellipsoid_volume(grid, center, axes), grid, views("tilted"), DET_SHAPE)
        errors.append(relative_rms(images, truth))
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_relabelled_grid_gives_the_same_images(backend):
    grid = straight_grid()
    volume = torch.rand(grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = project_volume(volume, grid, views("steep"), DET_SHAPE, backend=backend)
    last = grid.points(dtype=torch.float64)[-1, 0, 0].tolist()
    # x, y, z of the new grid are the old z (downwards), x and y
    renamed = VolumeGrid(
        (18, 20, 14),
        (grid.spacing[2], grid.spacing[0], grid.spacing[1]),
        last,
        [[0, 1, 0], [0, 0, 1], [-1, 0, 0]],
    )
    images = project_volume(volume.flip(0).permute(1, 2, 0), renamed, views("steep"), DET_SHAPE, backend=backend)
    torch.testing.assert_close(images, expected, rtol=1e-9, atol=1e-9)


def test_moving_the_volume_is_moving_the_gantry_back():
    turn = rotation((3, 1, 2), 15)
    grid = straight_grid()
    moved = VolumeGrid(
        grid.shape, grid.spacing, (turn @ torch.tensor(grid.origin, dtype=torch.float64) + 2).tolist(), turn.tolist()
    )
    back = torch.eye(4, dtype=torch.float64)
    back[:3, :3], back[:3, 3] = turn, 2
    volume = torch.rand(grid.shape, dtype=torch.float64)
    torch.testing.assert_close(
        project_volume(volume, moved, views("upright"), DET_SHAPE),
        project_volume(volume, grid, views("upright") @ back, DET_SHAPE),
    )


@pytest.mark.parametrize("kind", ["upright", "tilted"])
def test_the_scale_and_sign_of_a_matrix_do_not_matter(kind):
    volume, grid = torch.rand(14, 18, 20), straight_grid()
    images = project_volume(volume, grid, views(kind), DET_SHAPE)
    torch.testing.assert_close(project_volume(volume, grid, -3 * views(kind), DET_SHAPE), images)
    weighted = backproject_weighted(images, grid, views(kind))
    torch.testing.assert_close(backproject_weighted(images, grid, -3 * views(kind)), weighted)


@pytest.mark.parametrize("kind", ["upright", "tilted"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_volume_outside_the_field_of_view_has_no_image(kind, backend):
    beside = VolumeGrid.centered((8, 8, 8), 1.0, center=(0.0, 0.0, 300.0))
    volume = torch.ones(beside.shape)
    assert project_volume(volume, beside, views(kind), DET_SHAPE, backend=backend).eq(0).all()
    images = torch.ones(5, *DET_SHAPE)
    assert backproject(images, beside, views(kind), backend=backend).eq(0).all()
    assert backproject_weighted(images, beside, views(kind), backend=backend).eq(0).all()


@pytest.mark.parametrize("turn", [0.0, 2.0], ids=["upright", "tilted"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_rays_start_at_a_source_inside_the_volume(backend, turn):
    matrices = tilted(camera(0.0, det_shape=(8, 8), pixel=1.0), turn)  # the source at x = 404, rays towards -x
    grid = VolumeGrid.centered((41, 41, 40), 1.0, center=(400.0, 0.0, 0.0))
    images = project_volume(torch.ones(grid.shape), grid, matrices, (8, 8), backend=backend)
    torch.testing.assert_close(images[0], torch.full((8, 8), 24.0), rtol=1e-3, atol=0)  # from 404 to 380


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", KINDS)
def test_weighted_backprojection_of_a_ramp_reads_the_pixel_of_each_voxel(kind, backend):
    grid = VolumeGrid.centered((6, 5, 7), (3.0, 2.0, 2.5), center=(1.0, 2.0, -1.0))
    u = torch.arange(DET_SHAPE[1], dtype=torch.float64)
    v = torch.arange(DET_SHAPE[0], dtype=torch.float64)[:, None]
    image = (2 + 0.3 * u - 0.2 * v).expand(5, *DET_SHAPE)
    geometry = ConeBeamGeometry(views(kind), DET_SHAPE, (PIXEL, PIXEL))
    uv, depth = geometry.project(grid.points(dtype=torch.float64).reshape(-1, 3))
    limit = torch.tensor([DET_SHAPE[1] - 1.0, DET_SHAPE[0] - 1.0]).double()
    assert ((uv > 0) & (uv < limit)).all()
    expected = ((2 + 0.3 * uv[..., 0] - 0.2 * uv[..., 1]) / depth**2).sum(0)
    volume = backproject_weighted(image, grid, views(kind), backend=backend)
    torch.testing.assert_close(volume.flatten(), expected, rtol=1e-6, atol=0)


def test_the_module_projects_subsets_of_views():
    geometry = circular_geometry(range(0, 360, 40), sad=404, sdd=538, det_shape=(20, 24), pixel_spacing=(3.0, 3.0))
    grid = VolumeGrid.centered((10, 12, 14), 2.0)
    projector = VolumeProjector(geometry, grid)
    volume = torch.rand(grid.shape)
    everything = projector(volume)
    assert everything.shape == (9, 20, 24)
    for subset in (slice(1, None, 3), [7, 0, -2], torch.tensor([4])):
        chosen = torch.arange(9)[subset]
        assert torch.equal(projector(volume, views=subset), everything[chosen])
        part = everything[subset]
        expected = backproject(part.clone(), grid, geometry.projection_matrices[chosen])
        assert torch.equal(projector.adjoint(part, views=subset), expected)
    assert "projection_matrices" in dict(projector.geometry.named_buffers())


def test_leading_axes_are_candidates():
    volumes, grid = torch.rand(2, 3, 14, 18, 20), straight_grid()
    images = project_volume(volumes, grid, views("upright"), DET_SHAPE)
    assert images.shape == (2, 3, 5, *DET_SHAPE)
    assert torch.equal(images[1, 2], project_volume(volumes[1, 2], grid, views("upright"), DET_SHAPE))
    back = backproject(images, grid, views("upright"))
    assert torch.equal(back[1, 2], backproject(images[1, 2], grid, views("upright")))
    assert backproject_weighted(images, grid, views("upright")).shape == volumes.shape


def test_bad_input_is_refused_in_a_line():
    grid, matrices, volume = straight_grid(), views("upright"), torch.rand(14, 18, 20)
    images = torch.rand(5, *DET_SHAPE)
    singular, unknown = matrices.clone(), matrices.clone()
    singular[2, 0] = singular[2, 1]
    unknown[1, 0, 2] = torch.nan
    for message, call in (
        (r"volume must have shape \(\.\.\., 14, 18, 20\)", lambda: project_volume(volume.mT, grid, matrices, (4, 4))),
        ("float32 or float64", lambda: project_volume(volume.long(), grid, matrices, (4, 4))),
        (r"shape \(V, 3, 4\)", lambda: project_volume(volume, grid, matrices[0], (4, 4))),
        ("must be finite", lambda: project_volume(volume, grid, unknown, (4, 4))),
        ("invertible", lambda: project_volume(volume, grid, singular, (4, 4))),
        ("must not require a gradient", lambda: project_volume(volume, grid, matrices.requires_grad_(), (4, 4))),
        ("det_shape", lambda: project_volume(volume, grid, matrices.detach(), (0, 4))),
        ("backend must be one of", lambda: project_volume(volume, grid, matrices.detach(), (4, 4), backend="fast")),
        ("V = 5 matrices", lambda: backproject(images[:4], grid, matrices.detach())),
        ("V = 4 matrices", lambda: backproject_weighted(images, grid, matrices.detach()[:4])),
        ("must be finite", lambda: backproject(images, grid, unknown)),
        ("must be finite", lambda: backproject_weighted(images, grid, unknown)),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    projector = VolumeProjector(ConeBeamGeometry(matrices.detach(), DET_SHAPE, (PIXEL, PIXEL)), grid)
    with pytest.raises(ValueError, match="must name some of the 5 views"):
        projector(volume, views=[5])
    with pytest.raises(ValueError, match=r"projections must have shape \(\.\.\., V, 24, 30\)"):
        projector.adjoint(images.mT)

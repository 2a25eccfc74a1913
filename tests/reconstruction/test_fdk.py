import math

import pytest
import torch

from torchkcreg.geometry import (
    ConeBeamGeometry,
    MultisourceScanner,
    VolumeGrid,
    circular_geometry,
    matrices_from_frames,
    rigid_matrix,
)
from torchkcreg.reconstruction import FDKConfig, fdk
from torchkcreg.simulation.solids import Cylinder, Sphere

PANEL = {"sad": 404, "sdd": 538, "det_shape": (44, 56), "pixel_spacing": (2.4, 2.4)}
GRID = VolumeGrid.centered((9, 29, 29), 2.5)
CENTER = torch.tensor([5.0, -8.0, 3.0])
BALL = [(Sphere(CENTER, 20.0), 0.02)]


def tilted_geometry():
    b = torch.arange(0, 360, 4.0).deg2rad().double()
    zero = torch.zeros_like(b)
    radial = torch.stack([b.cos(), b.sin(), zero], 1)
    across = torch.stack([-b.sin(), b.cos(), zero], 1)
    up = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(radial)
    roll, pitch = math.radians(4), math.radians(6)
    columns = math.cos(roll) * across + math.sin(roll) * up
    rows = math.cos(pitch) * (math.cos(roll) * up - math.sin(roll) * across) + math.sin(pitch) * radial
    shape, spacing = PANEL["det_shape"], PANEL["pixel_spacing"]
    matrices = matrices_from_frames(404 * radial, -134 * radial, columns, rows, det_shape=shape, pixel_spacing=spacing)
    return ConeBeamGeometry(matrices, shape, spacing)


GEOMETRIES = {
    "full scan": lambda: circular_geometry(range(0, 360, 4), **PANEL),
    "short scan": lambda: circular_geometry(range(0, 200, 2), **PANEL),
    "long short scan, backwards": lambda: circular_geometry(range(270, 0, -3), **PANEL),
    "offset detector": lambda: circular_geometry(range(0, 360, 3), **PANEL, det_offset_mm=(0, 30)),
    "offset the other way": lambda: circular_geometry(range(0, 360, 3), **PANEL, det_offset_mm=(3, -30)),
    "tilted detector": tilted_geometry,
    "columns flipped": lambda: flipped(circular_geometry(range(0, 360, 4), **PANEL)),
    "three focal spots": lambda: MultisourceScanner(det_shape=(80, 56), det_size_mm=(298, 134)).geometry(),
}


def flipped(geometry):
    matrices = geometry.projection_matrices.clone()
    matrices[:, 0] = (geometry.det_shape[1] - 1) * matrices[:, 2] - matrices[:, 0]
    return ConeBeamGeometry(matrices, geometry.det_shape, geometry.pixel_spacing)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_a_ball_comes_out_with_its_attenuation(name, line_integrals_of):
    geometry = GEOMETRIES[name]()
    volume = fdk(line_integrals_of(BALL, geometry), geometry, GRID)
    distance = (GRID.points() - CENTER).norm(dim=-1)
    inside, outside = volume[distance < 15], volume[distance > 26]
    assert inside.mean() == pytest.approx(0.02, rel=0.002)
    assert inside.std() < 1e-4
    assert outside.abs().mean() < 2e-4


def test_a_long_cylinder_keeps_its_attenuation_high_above_the_plane_of_the_source(line_integrals_of):
    """FDK is exact for what does not change with height, if oblique rays get their cosine."""
    geometry = circular_geometry(range(0, 360, 4), sad=404, sdd=538, det_shape=(90, 40), pixel_spacing=(3.0, 3.0))
    axis = torch.tensor([0.0, 0.0, 300.0])
    images = line_integrals_of([(Cylinder(-axis, axis, 20.0), 0.02)], geometry)
    volume = fdk(images, geometry, VolumeGrid.centered((3, 5, 5), 2.5, center=(0, 0, 80)))
    assert volume.mean() == pytest.approx(0.02, rel=0.003)


def test_moving_the_gantry_moves_the_volume(line_integrals_of):
    turn = rigid_matrix(torch.tensor([0.0, 0.0, 0.3]).double(), torch.tensor([0.0, 0.0, 5.0]).double())
    geometry = circular_geometry(range(0, 360, 4), **PANEL)
    images = line_integrals_of(BALL, geometry)
    still = fdk(images, geometry, GRID)
    axes = turn[:3, :3].T.tolist()
    origin = torch.linalg.inv(turn)[:3] @ torch.tensor([*GRID.origin, 1.0]).double()
    moved_grid = VolumeGrid(GRID.shape, GRID.spacing, tuple(origin.tolist()), axes)
    assert torch.allclose(fdk(images, geometry.moved(turn), moved_grid), still, atol=1e-6)


def test_a_truncated_object_keeps_its_level_with_extrapolation(line_integrals_of):
    geometry = circular_geometry(range(0, 360, 4), **PANEL)
    axis = torch.tensor([0.0, 0.0, 100.0])
    images = line_integrals_of([(Cylinder(-axis, axis, 70.0), 0.02)], geometry)
    errors = {}
    for extrapolate in (True, False):
        grid = VolumeGrid.centered((1, 33, 33), 2.5)
        volume = fdk(images, geometry, grid, config=FDKConfig(extrapolate=extrapolate))
        errors[extrapolate] = (volume - 0.02)[grid.points()[..., :2].norm(dim=-1) < 35].abs().mean()
    assert errors[True] < 0.6 * errors[False]


def test_three_focal_spots_make_fewer_cone_beam_artefacts_than_the_middle_one(line_integrals_of):
    scanner = MultisourceScanner(det_shape=(128, 48), det_size_mm=(298, 112))
    geometry = scanner.geometry()
    heights = range(-96, 97, 16)
    stack = [(Cylinder(torch.tensor([0.0, 0, z - 4]), torch.tensor([0.0, 0, z + 4]), 30.0), 0.02) for z in heights]
    images = line_integrals_of(stack, geometry)
    grid = VolumeGrid.centered((81, 15, 15), (4.0, 4.0, 2.4))
    z = grid.points()[..., 2]
    share = torch.stack([((4 + 1.2 - (z - height).abs()) / 2.4).clamp(0, 1) for height in heights]).sum(0)
    inside = (grid.points()[..., :2].norm(dim=-1) < 26) & (z.abs() < 94)
    middle = [view for view, source in enumerate(geometry.sources) if source == "T2"]
    three = fdk(images, geometry, grid) - 0.02 * share
    alone = fdk(images[middle], geometry.select(middle), grid) - 0.02 * share
    all_as_one = fdk(images, geometry, grid, config=FDKConfig(combine=False)) - 0.02 * share

    def error(volume):
        return float(volume[inside].square().mean().sqrt())

    assert error(three) < 0.85 * error(alone)
    assert error(three) < 0.8 * error(all_as_one)


def test_leading_axes_are_candidates():
    geometry = circular_geometry(range(0, 360, 30), **PANEL)
    images = torch.rand(2, 12, 44, 56, generator=torch.Generator().manual_seed(0))
    grid = VolumeGrid.centered((2, 5, 5), 4.0)
    assert torch.allclose(fdk(images, geometry, grid)[1], fdk(images[1], geometry, grid), atol=1e-8)


def test_what_does_not_fit_is_named():
    geometry = circular_geometry(range(0, 360, 30), **PANEL)
    images = torch.zeros(12, 44, 56)
    with pytest.raises(ValueError, match="projections must have shape"):
        fdk(images[:5], geometry, GRID)
    with pytest.raises(ValueError, match="projections must be finite, got 1"):
        fdk(
            images.index_put((torch.tensor([1]), torch.tensor([2]), torch.tensor([3])), torch.tensor(math.nan)),
            geometry,
            GRID,
        )
    with pytest.raises(ValueError, match="field of view"):
        fdk(images, geometry, VolumeGrid.centered((4, 4, 4), 1.0, center=(0, 0, 500)))
    with pytest.raises(ValueError, match="cover 120 degrees"):
        short = circular_geometry(range(0, 120, 2), **PANEL)
        fdk(torch.zeros(60, 44, 56), short, GRID)


def test_a_height_that_one_spot_does_not_see_comes_from_the_one_that_does(line_integrals_of):
    scanner = MultisourceScanner(det_shape=(40, 32), det_size_mm=(80, 128))  # T2 sees up to 30 mm, T1 from 0 to 60
    geometry = scanner.geometry()
    axis = torch.tensor([0.0, 0.0, 300.0])
    images = line_integrals_of([(Cylinder(-axis, axis, 20.0), 0.02)], geometry)
    volume = fdk(images, geometry, VolumeGrid.centered((3, 5, 5), 2.5, center=(0, 0, 40)))
    assert volume.mean() == pytest.approx(0.02, rel=0.02)

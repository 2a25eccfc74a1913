"""Any P: signs follow from where the views look, not from the world's origin."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner, circular_geometry

BEAD = torch.tensor([[3.0, -5.0, 8.0]], dtype=torch.float64)


def neighbours() -> ConeBeamGeometry:
    return MultisourceScanner().geometry().select([47, 48, 49])


def moved(geometry: ConeBeamGeometry, shift: torch.Tensor, *, scales: torch.Tensor | None = None) -> ConeBeamGeometry:
    """The same views in a world whose origin is at ``shift``."""
    matrices = geometry.projection_matrices.clone()
    matrices[:, :, 3] += matrices[:, :, :3] @ shift
    if scales is not None:
        matrices = matrices * scales[:, None, None]
    return ConeBeamGeometry(matrices, geometry.det_shape, geometry.pixel_spacing)


@pytest.mark.parametrize("distance", [0.0, 300.0, 500.0, 5000.0])
def test_the_worlds_origin_may_be_anywhere(distance: float) -> None:
    """500 mm towards the tube it is behind the sources."""
    geometry = neighbours()
    towards = torch.nn.functional.normalize(geometry.source_positions.mean(0), dim=0)
    other = moved(geometry, distance * towards)
    uv, depth = geometry.project(BEAD)
    found, as_deep = other.project(BEAD - distance * towards)
    torch.testing.assert_close(found, uv)
    torch.testing.assert_close(as_deep, depth)
    assert other.knows_front and bool((depth > 0).all())


def test_the_origin_may_be_a_source() -> None:
    geometry = neighbours()
    source = geometry.source_positions[1]
    matrices = moved(geometry, source).projection_matrices.clone()
    matrices[1, :, 3] = 0.0
    other = ConeBeamGeometry(matrices, geometry.det_shape, geometry.pixel_spacing)
    torch.testing.assert_close(other.project(BEAD - source), geometry.project(BEAD))


def test_scale_and_sign_of_every_matrix_are_free() -> None:
    geometry = neighbours()
    other = moved(geometry, torch.zeros(3).double(), scales=torch.tensor([-2.0, 1e-3, -7e4]).double())
    torch.testing.assert_close(other.projection_matrices, geometry.projection_matrices)


def test_a_whole_circle_knows_its_front() -> None:
    geometry = circular_geometry(
        list(range(0, 360, 30)), sad=404, sdd=538, det_shape=(40, 40), pixel_spacing=(4.0, 4.0)
    )
    flipped = moved(geometry, torch.tensor([800.0, 10.0, 3.0]).double(), scales=-torch.ones(12).double())
    assert flipped.knows_front
    centre = torch.tensor([[-800.0, -10.0, -3.0]], dtype=torch.float64)
    torch.testing.assert_close(flipped.project(centre)[1], torch.full((12, 1), 404.0, dtype=torch.float64))


def test_a_single_view_looks_at_the_origin_and_at_its_source_as_its_sign_says() -> None:
    camera = torch.eye(3, 4, dtype=torch.float64)[None]
    camera[0, :2, 2] = 20.0
    camera[0, 0, 0] = camera[0, 1, 1] = 500.0
    geometry = ConeBeamGeometry(camera, (40, 40), (1.0, 1.0))
    assert not geometry.knows_front
    assert float(geometry.project(torch.tensor([[0.0, 0.0, 300.0]]))[1]) == 300.0
    behind = camera.clone()
    behind[0, 2, 3] = -400.0  # the origin 400 mm behind the source, or in front of it: one view cannot know
    assert float(ConeBeamGeometry(behind, (40, 40), (1.0, 1.0)).project(torch.zeros(1, 3))[1]) == 400.0


def test_a_single_view_is_turned_towards_the_object() -> None:
    geometry = neighbours().select([1])
    matrix = geometry.projection_matrices.clone()
    towards = torch.nn.functional.normalize(geometry.source_positions[0], dim=0)
    matrix[:, :, 3] += matrix[:, :, :3] @ (500.0 * towards)
    alone = ConeBeamGeometry(matrix, geometry.det_shape, geometry.pixel_spacing)
    bead = BEAD - 500.0 * towards
    assert float(alone.project(bead)[1]) < 0
    torch.testing.assert_close(alone.facing(bead).project(bead), geometry.project(BEAD))
    assert bool((alone.facing(bead).select([0]).bin(2).project(bead)[1] > 0).all())


def test_an_object_behind_the_source_is_refused_in_one_line() -> None:
    geometry = neighbours()
    towards = torch.nn.functional.normalize(geometry.source_positions.mean(0), dim=0)
    with pytest.raises(ValueError, match=r"behind the X-ray source of view 0, 1, 2 \(depth -"):
        geometry.facing(BEAD + 600 * towards)
    with pytest.raises(ValueError, match="behind the X-ray source"):  # a part of it
        geometry.facing(torch.cat([BEAD, BEAD + 600 * towards]))
    torch.testing.assert_close(geometry.facing(BEAD).projection_matrices, geometry.projection_matrices)


def test_one_source_that_turns_keeps_to_the_origin() -> None:
    """The central rays of K [R | 0] meet in the source, which is neither in front nor behind."""
    angles = torch.tensor([0.0, 0.3, 0.6], dtype=torch.float64)
    cos, sin, zero, one = angles.cos(), angles.sin(), torch.zeros(3).double(), torch.ones(3).double()
    turns = torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], -1).reshape(3, 3, 3)
    camera = torch.tensor([[500.0, 0, 20], [0, 500, 20], [0, 0, 1]], dtype=torch.float64)
    matrices = torch.cat([camera @ turns, torch.zeros(3, 3, 1).double()], dim=-1)
    geometry = ConeBeamGeometry(matrices, (41, 41), (1.0, 1.0))
    assert not geometry.knows_front
    torch.testing.assert_close(geometry.projection_matrices, matrices)

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.geometry import ConeBeamGeometry, circular_geometry, rigid_matrix, transform_points


def _geometry(**changes) -> ConeBeamGeometry:
    options = {
        "sad": 404.0,
        "sdd": 538.0,
        "det_shape": (20, 30),
        "pixel_spacing": (4.0, 5.0),
        "source_z_mm": [120.0, 0.0, -120.0],
        "sources": ["T1", "T2", "T3"],
    }
    return circular_geometry([91.0, 92.0, 200.0], **(options | changes))


def _points(count: int = 9, spread: float = 40.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return spread * torch.randn(count, 3, generator=generator, dtype=torch.float64)


def test_projection_equals_the_intersection_of_the_ray_with_the_detector() -> None:
    geometry = _geometry(det_offset_mm=(3.0, -2.0))
    points = _points()
    uv, depth = geometry.project(points)
    assert uv.shape == (3, 9, 2) and depth.shape == (3, 9)
    for view, (angle, height) in enumerate([(91.0, 120.0), (92.0, 0.0), (200.0, -120.0)]):
        cos, sin = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        source = torch.tensor([404 * cos, 404 * sin, height], dtype=torch.float64)
        normal = torch.tensor([-cos, -sin, 0.0], dtype=torch.float64)
        column_axis = torch.tensor([-sin, cos, 0.0], dtype=torch.float64)
        center = (538 - 404) * normal - 2.0 * column_axis + torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
        expected_depth = (points - source) @ normal
        hit = source + (points - source) * (538.0 / expected_depth)[:, None]
        u = (hit - center) @ column_axis / 5.0 + 14.5
        v = (hit - center)[:, 2] / 4.0 + 9.5
        torch.testing.assert_close(depth[view], expected_depth)
        torch.testing.assert_close(uv[view], torch.stack([u, v], dim=-1))
        torch.testing.assert_close(geometry.source_positions[view], source)


def test_matrices_are_scaled_to_depth_in_mm_whatever_their_scale_and_sign() -> None:
    reference = _geometry().projection_matrices
    scaled = reference * torch.tensor([-2.0, 1e-3, -7e4], dtype=torch.float64)[:, None, None]
    geometry = ConeBeamGeometry(scaled, (20, 30), (4.0, 5.0))
    torch.testing.assert_close(geometry.projection_matrices, reference)
    assert (geometry.project(torch.zeros(1, 3))[1] > 0).all()
    assert (torch.linalg.det(reference[:, :, :3]) < 0).all()  # u, v and the ray are left-handed


def test_pixel_positions_project_to_their_own_pixels_and_lie_one_spacing_apart() -> None:
    geometry = _geometry()
    positions = geometry.pixel_positions()
    torch.testing.assert_close(geometry.detector_distances, torch.full((3,), 538.0, dtype=torch.float64))
    for view in range(3):
        uv, depth = geometry.select([view]).project(positions[view].reshape(-1, 3))
        v, u = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
        expected = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
        torch.testing.assert_close(uv[0], expected, rtol=0, atol=1e-10)
        torch.testing.assert_close(depth[0], torch.full((600,), 538.0, dtype=torch.float64))
    along_rows = positions.diff(dim=1).norm(dim=-1)
    along_cols = positions.diff(dim=2).norm(dim=-1)
    torch.testing.assert_close(along_rows, torch.full_like(along_rows, 4.0))
    torch.testing.assert_close(along_cols, torch.full_like(along_cols, 5.0))


def test_obliquity_is_the_distance_to_the_pixel_over_the_distance_to_the_detector() -> None:
    geometry = _geometry()
    distances = (geometry.pixel_positions() - geometry.source_positions[:, None, None]).norm(dim=-1)
    torch.testing.assert_close(geometry.obliquity(), distances / 538.0)


def test_a_tilted_detector_keeps_its_pixels_and_its_distance() -> None:
    tilt = rigid_matrix(torch.tensor([0.1, 0.2, 0.3]), torch.tensor([1.0, 2.0, 3.0])).double()
    tilted = _geometry().moved(tilt)
    torch.testing.assert_close(tilted.detector_distances, torch.full((3,), 538.0, dtype=torch.float64))
    uv, _ = tilted.select([0]).project(tilted.pixel_positions()[0, 7])
    torch.testing.assert_close(uv[0, :, 1], torch.full((30,), 7.0, dtype=torch.float64))


def test_a_spacing_that_does_not_fit_the_matrices_is_refused_when_positions_are_asked_for() -> None:
    geometry = ConeBeamGeometry(_geometry().projection_matrices, (20, 30), (4.0, 4.0))
    with pytest.raises(ValueError, match="pixel_spacing"):
        geometry.pixel_positions()


def test_moving_the_world_is_moving_the_gantry_back() -> None:
    geometry, points = _geometry(), _points()
    transform = rigid_matrix(torch.tensor([0.3, -0.2, 0.5]), torch.tensor([10.0, -5.0, 800.0])).double()
    expected_uv, expected_depth = geometry.project(transform_points(transform, points))
    uv, depth = geometry.moved(transform).project(points)
    torch.testing.assert_close(uv, expected_uv)
    torch.testing.assert_close(depth, expected_depth)
    behind = rigid_matrix(torch.tensor([0.0, 0.0, torch.pi]), torch.tensor([0.0, 1000.0, 0.0])).double()
    assert (geometry.moved(behind).project(torch.zeros(1, 3))[1][:2] < 0).all()  # the sign of the depth is kept


def test_each_view_can_see_its_own_motion() -> None:
    geometry, points = _geometry(), _points()
    transforms = rigid_matrix(torch.eye(3) * 0.1, torch.eye(3) * 5).double()
    uv, _ = geometry.moved(transforms).project(points)
    for view in range(3):
        expected = geometry.project(transform_points(transforms[view], points))[0][view]
        torch.testing.assert_close(uv[view], expected)


def test_the_gradient_reaches_a_motion_of_the_world() -> None:
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    uv, _ = _geometry().moved(rigid_matrix(vector, shift)).project(_points())
    uv.square().sum().backward()
    assert vector.grad is not None and (vector.grad != 0).all()
    assert shift.grad is not None and (shift.grad != 0).all()


def test_cropping_keeps_the_rays_of_the_pixels_that_stay() -> None:
    geometry = _geometry()
    cropped = geometry.crop(slice(3, -2), slice(5, 25))
    assert cropped.det_shape == (15, 20) and cropped.sources == ("T1", "T2", "T3")
    torch.testing.assert_close(cropped.pixel_positions(), geometry.pixel_positions()[:, 3:18, 5:25])


def test_binned_pixels_are_centred_on_their_blocks() -> None:
    geometry = _geometry()
    binned = geometry.bin(3)
    assert binned.det_shape == (6, 10) and binned.pixel_spacing == (12.0, 15.0)
    positions = geometry.pixel_positions()[:, :18]
    blocks = positions.reshape(3, 6, 3, 10, 3, 3).mean(dim=(2, 4))
    torch.testing.assert_close(binned.pixel_positions(), blocks)


def test_labels_stay_with_their_views() -> None:
    chosen = _geometry().select([2, 0])
    assert chosen.sources == ("T3", "T1") and chosen.angles_deg == (200.0, 91.0)
    torch.testing.assert_close(chosen.projection_matrices, _geometry().projection_matrices[[2, 0]])
    assert _geometry().select(slice(1, None)).sources == ("T2", "T3")


def test_nearest_views_wrap_around_and_can_ask_for_a_source() -> None:
    geometry = circular_geometry(
        [0.0, 90.0, 180.0, 350.0],
        sad=404,
        sdd=538,
        det_shape=(8, 8),
        pixel_spacing=(1, 1),
        sources=["a", "b", "a", "b"],
    )
    assert geometry.nearest_views([358.0, -11.0, 80.0, 450.0]) == [0, 3, 1, 1]
    assert geometry.nearest_views([358.0, 45.0], sources=["b", "a"]) == [3, 0]
    assert geometry.nearest_views([358.0, 100.0], sources="a") == [0, 2]
    with pytest.raises(ValueError, match="sources must be among"):
        geometry.nearest_views([0.0], sources="c")


def test_points_keep_their_dtype_and_leading_dimensions() -> None:
    uv, depth = _geometry().project(torch.zeros(2, 4, 5, 3))
    assert uv.shape == (2, 4, 3, 5, 2) and uv.dtype == torch.float32
    assert depth.shape == (2, 4, 3, 5) and depth.dtype == torch.float32


def test_matrices_stay_in_double_precision_when_the_module_is_cast() -> None:
    geometry = torch.nn.Sequential(_geometry())
    before = geometry[0].projection_matrices.clone()
    after = geometry.float()[0].projection_matrices
    assert after.dtype == torch.float64 and torch.equal(before, after)


def test_a_geometry_reloads_from_its_state() -> None:
    other = ConeBeamGeometry(_geometry().projection_matrices.flip(0), (20, 30), (4.0, 5.0))
    other.load_state_dict(_geometry().state_dict())
    assert torch.equal(other.projection_matrices, _geometry().projection_matrices)
    assert "num_views=3" in repr(_geometry()) and "T1:1/T2:1/T3:1" in repr(_geometry())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"projection_matrices": torch.zeros(3, 4)}, r"shape \(V, 3, 4\)"),
        ({"projection_matrices": torch.zeros(0, 3, 4)}, r"shape \(V, 3, 4\)"),
        ({"projection_matrices": torch.full((1, 3, 4), torch.nan)}, "finite"),
        ({"projection_matrices": torch.zeros(1, 3, 4)}, "invertible"),
        ({"det_shape": (0, 4)}, "det_shape"),
        ({"det_shape": (4, 4, 4)}, "det_shape"),
        ({"pixel_spacing": (1.0, -1.0)}, "pixel_spacing"),
        ({"pixel_spacing": (1.0, math.nan)}, "pixel_spacing"),
        ({"sources": ["T1"]}, "sources must have one entry"),
        ({"angles_deg": [1.0]}, "angles_deg must have one entry"),
    ],
)
def test_what_is_no_geometry_is_refused(changes: dict, message: str) -> None:
    options = {
        "projection_matrices": _geometry().projection_matrices,
        "det_shape": (4, 4),
        "pixel_spacing": (1, 1),
    } | changes
    with pytest.raises(ValueError, match=message):
        ConeBeamGeometry(**options)


def test_impossible_requests_are_refused() -> None:
    geometry = _geometry()
    for request in (
        lambda: geometry.select([]),
        lambda: geometry.select([3]),
        lambda: geometry.crop(slice(0, 10, 2), slice(None)),
        lambda: geometry.crop(slice(9, 9), slice(None)),
        lambda: geometry.bin(0),
        lambda: geometry.bin(21),
        lambda: geometry.moved(torch.eye(3)),
        lambda: geometry.moved(torch.zeros(4, 4)),
        lambda: geometry.project(torch.zeros(3, 4)),
        lambda: geometry.nearest_views([1.0], sources=["T1", "T2"]),
        lambda: ConeBeamGeometry(geometry.projection_matrices, (4, 4), (1, 1)).nearest_views([1.0]),
        lambda: circular_geometry([0.0], sad=500, sdd=400, det_shape=(4, 4), pixel_spacing=(1, 1)),
        lambda: circular_geometry([], sad=404, sdd=538, det_shape=(4, 4), pixel_spacing=(1, 1)),
        lambda: _geometry(source_z_mm=[1.0, 2.0]),
    ):
        with pytest.raises(ValueError):
            request()


def test_a_calibration_whose_rows_and_columns_differ_a_little_is_taken() -> None:
    """Focal lengths of calibrated image intensifiers differ by half a percent between columns and rows."""
    matrix = torch.tensor([[4577.0, 0, 395, 0], [0, 4602, 588, 0], [0, 0, 1, 1000]]).double()[None]
    geometry = ConeBeamGeometry(matrix, (1024, 1024), (0.39, 0.39))
    assert float(geometry.detector_distances) == pytest.approx(0.39 * (4577 + 4602) / 2)
    wrong = ConeBeamGeometry(matrix, (1024, 1024), (0.39, 0.37))
    with pytest.raises(ValueError, match="pixel aspect"):
        wrong.detector_distances  # noqa: B018

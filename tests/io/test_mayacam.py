"""Calibrations of XMALab's MayaCam 2.0: written and read back, damaged ones named."""

from __future__ import annotations

import pytest
import torch

from torchkcreg.geometry import ConeBeamGeometry, circular_geometry
from torchkcreg.io import read_geometry, read_mayacam, write_mayacam

UPWARDS = circular_geometry([20.0, 90.0], sad=1000, sdd=1400, det_shape=(300, 400), pixel_spacing=(0.4, 0.4))
MATRICES = UPWARDS.projection_matrices.clone()
MATRICES[:, 1] = 299 * MATRICES[:, 2] - MATRICES[:, 1]  # rows from the top
TWO = ConeBeamGeometry(MATRICES, (300, 400), (0.4, 0.4))


@pytest.fixture
def folder(tmp_path):
    """Two cameras."""
    write_mayacam(tmp_path, TWO)
    return tmp_path


def test_the_rays_come_back(folder) -> None:
    geometry = read_geometry(folder)
    points = 80 * torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).double() - 40
    torch.testing.assert_close(geometry.project(points)[0], TWO.project(points)[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(geometry.source_positions, TWO.source_positions, atol=1e-6, rtol=0)
    assert geometry.det_shape == (300, 400) and geometry.sources == ("camera_0", "camera_1")
    assert read_geometry(folder / "camera_1.txt").num_views == 1


def test_pixels_are_chosen_so_that_what_is_in_the_middle_is_magnified_as_usual(folder) -> None:
    geometry = read_geometry(folder)
    assert float(geometry.detector_distances.mean()) == pytest.approx(1.3 * 1000, rel=1e-6)
    known = read_geometry(folder, pixel_spacing=(0.4, 0.4))
    assert float(known.detector_distances.mean()) == pytest.approx(1400, rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("translation", "shift", "no block 'translation'"),
        ("400,300", "400;300", "no block 'image size'"),
        ("0,0,1", "0,1", "'camera matrix'"),
        ("400,300", "300,400", "different sizes"),
    ],
)
def test_a_damaged_file_is_named(folder, old, new, message) -> None:
    path = folder / "camera_0.txt"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_geometry(folder)


def test_rows_that_run_upwards_are_no_camera(tmp_path) -> None:
    with pytest.raises(ValueError, match="view 0 is mirrored"):
        write_mayacam(tmp_path, UPWARDS)


def test_images_of_another_size_are_refused(folder) -> None:
    with pytest.raises(ValueError, match="300 x 400 pixels"):
        read_geometry(folder, det_shape=(400, 300))
    with pytest.raises(ValueError, match="holds no MayaCam"):
        read_mayacam([])

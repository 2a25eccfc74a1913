"""Surfaces of implants out of bench scans."""

import sys

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage

from torchkcreg.geometry import VolumeGrid
from torchkcreg.implant import ImplantPointCloud, find_holes, scanned_surface
from torchkcreg.io import read_mesh, write_volume
from torchkcreg.simulation import locking_plate

pytest.importorskip("skimage")
PITCH = 0.3


def scan(*meshes: trimesh.Trimesh, size=(70.0, 9.0, 18.0), blur=0.8, noise=0.02, dark=0.0):
    """A volume of metal of the value 0.3 in air, as a scanner would blur it, its middle too dark by a share."""
    shape = [round(s / PITCH) for s in size]
    grid = VolumeGrid.centered(shape, PITCH)
    values = np.zeros(shape)
    for mesh in meshes:
        cloud = ImplantPointCloud.from_mesh(
            mesh, PITCH, origin=[x - PITCH / 2 for x in grid.origin], at_centroids=False
        )
        x, y, z = torch.round((cloud.points.double() - torch.tensor(grid.origin)) / PITCH).long().T
        inside = (z >= 0) & (z < shape[0])
        values[z[inside], y[inside], x[inside]] += cloud.volumes[inside].numpy() / PITCH**3
    depth = ndimage.distance_transform_edt(values > 0.5) * PITCH
    values *= 1 - dark * (depth / max(depth.max(), 1e-9)).clip(0, 1)
    values = ndimage.gaussian_filter(values, blur) + noise * np.random.default_rng(0).normal(size=shape)
    return torch.from_numpy(0.3 * values), grid


@pytest.fixture(scope="module")
def plate() -> trimesh.Trimesh:
    return locking_plate(length=62.0, num_holes=3)


@pytest.mark.parametrize("dark", [0.0, 0.4])
def test_a_scanned_plate_is_closed_of_the_right_size_and_has_its_holes(plate, dark):
    surface = scanned_surface(*scan(plate, dark=dark))
    assert surface.is_watertight
    assert surface.volume == pytest.approx(plate.volume, rel=0.04)
    off = trimesh.proximity.closest_point(plate, surface.vertices[::50])[1]
    assert float(np.sqrt((off**2).mean())) < 0.06
    assert len(find_holes(surface)) == 3


def test_the_surface_is_where_the_volume_has_it(plate):
    volume, grid = scan(plate)
    turned = VolumeGrid(
        grid.shape, grid.spacing, (5.0, -3.0, 20.0), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    )
    here, there = scanned_surface(volume, grid), scanned_surface(volume, turned)
    back = np.linalg.inv(turned.voxel_to_world.numpy()) @ np.c_[there.vertices, np.ones(len(there.vertices))].T
    again = (grid.voxel_to_world.numpy() @ back)[:3].T
    assert np.abs(np.sort(again, axis=0) - np.sort(here.vertices, axis=0)).max() < 0.05
    assert there.volume > 0


def test_what_is_doubtful_about_a_scan_is_told(plate):
    with pytest.warns(UserWarning, match="reaches the edge"):
        scanned_surface(*scan(plate, size=(50.0, 9.0, 18.0)))
    other = trimesh.creation.box((3.0, 3.0, 20.0))
    other.apply_translation((0.0, 8.0, 0.0))
    with pytest.warns(UserWarning, match="holds 2 bodies"):
        surface = scanned_surface(*scan(plate, other, size=(70.0, 24.0, 18.0)))
    assert surface.bounds[1, 1] < 3.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.randn(20, 20, 20, generator=torch.Generator().manual_seed(0)), "nothing in the volume stands out"),
        (torch.zeros(20, 20, 20), "nothing in the volume stands out"),
        (torch.full((20, 20, 20), float("nan")), "finite"),
    ],
)
def test_a_volume_without_an_implant_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        scanned_surface(values, VolumeGrid.centered((20, 20, 20), 1.0))


def test_a_volume_file_is_read_as_an_implant_and_an_error_names_it(plate, tmp_path, monkeypatch):
    write_volume(tmp_path / "scan.nii.gz", *scan(plate))
    assert read_mesh(tmp_path / "scan.nii.gz").volume == pytest.approx(plate.volume, rel=0.03)
    write_volume(tmp_path / "air.mha", torch.zeros(8, 8, 8), VolumeGrid.centered((8, 8, 8), 1.0))
    with pytest.raises(ValueError, match=r"air\.mha: nothing"):
        read_mesh(tmp_path / "air.mha")
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ValueError, match=r"scikit-image: pip install 'torchkcreg\[io\]'"):
        read_mesh(tmp_path / "scan.nii.gz")

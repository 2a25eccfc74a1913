"""Scans that others measured; they lie beside the repository, where they are at all."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from scipy.io import loadmat

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import PWLSConfig, VoxelSystem, fdk, pwls, statistical_weights

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
needs_real_data = pytest.mark.skipif(not REAL.is_dir(), reason="no ../shared/real")


@pytest.mark.slow
@needs_real_data
def test_fdk_of_an_axisymmetric_specimen_is_the_vendors_slice():
    """One radiogram seen from everywhere; the vendor took 3142. The axis stands where the specimen's edges say."""
    image = np.load(REAL / "axitom" / "radiogram_bin4_f32.npz")["radiogram"]
    line_integrals = -np.log(np.clip(image, 1e-3, None))
    profile = line_integrals[20:180].mean(0)
    covered = np.flatnonzero(profile > 0.3 * profile.max())
    offset_mm = ((image.shape[1] - 1) / 2 - (covered[0] + covered[-1]) / 2) * 0.8
    geometry = circular_geometry(
        range(0, 360, 2),
        sad=76.7511959,
        sdd=1127.464,
        det_shape=image.shape,
        pixel_spacing=(0.8, 0.8),
        det_offset_mm=(0, offset_mm),
    )
    views = torch.from_numpy(line_integrals).float().expand(geometry.num_views, *image.shape).contiguous()
    pitch = 4 * 0.013614837863123
    grid = VolumeGrid((499, 1, 100), pitch, (pitch / 2, 0.0, -249 * pitch))
    ours = fdk(views, geometry, grid)[:, 0].flip(0).numpy()
    vendor = sitk.GetArrayFromImage(sitk.ReadImage(str(REAL / "axitom" / "recon_by_external_software.tif")))
    theirs = vendor[:1996].astype(float).reshape(499, 4, 100, 4).mean((1, 3))
    inner = (slice(30, 470), slice(3, 95))  # without the cone's truncated ends and the rings on the axis
    assert np.corrcoef(ours[inner].ravel(), theirs[inner].ravel())[0, 1] > 0.98


@pytest.mark.slow
@needs_real_data
def test_pwls_of_a_limited_angle_scan_shows_the_disc_and_its_holes():
    content = loadmat(REAL / "htc2022" / "htc2022_ta_sparse_example.mat", struct_as_record=False, squeeze_me=True)[
        "CtDataLimited"
    ]
    data = torch.from_numpy(content.sinogram).float()[:, None]
    geometry = circular_geometry(
        content.parameters.angles, sad=410.66, sdd=553.74, det_shape=(1, 560), pixel_spacing=(0.2, 0.2)
    )
    system = VoxelSystem(geometry, VolumeGrid.centered((1, 160, 160), 0.53))
    config = PWLSConfig(iterations=25, subsets=10, beta=1.0)
    volume = pwls(system, data, statistical_weights(torch.exp(-data)), config).volume
    points = system.grid.points()
    radius = points[0, ..., :2].norm(dim=-1)
    acrylic = volume[0][radius < 25]
    assert acrylic.median() > 10 * volume[0][radius > 41].median().clamp_min(1e-4)
    assert acrylic.quantile(0.05) < 0.75 * acrylic.median()  # the holes
    residual = system.project(volume, range(geometry.num_views)) - data
    assert residual.abs().mean() < 0.02 * data.max()

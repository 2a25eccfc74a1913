"""Scans that others measured; they lie beside the repository, where they are at all."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import PWLSConfig, VoxelSystem, pwls, statistical_weights

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared" / "real"
needs_real_data = pytest.mark.skipif(not REAL.is_dir(), reason="no ../shared/real")


@pytest.mark.slow
@needs_real_data
def test_fdk_of_an_axisymmetric_specimen_is_the_vendors_slice(monkeypatch):
    """One radiogram seen from everywhere; the vendor took 3142. The axis stands where the specimen's edges say."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from real_scans import axitom

    ours, theirs = axitom(REAL / "axitom")[1].values()
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.98


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

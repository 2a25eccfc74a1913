"""Filtered back-projection beside RTK's, where itk-rtk is installed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.reconstruction import FDKConfig, fdk
from torchkcreg.simulation.solids import Sphere

itk = pytest.importorskip("itk", reason="RTK (package itk-rtk) is not installed")
if not hasattr(itk, "RTK"):
    pytest.skip("RTK (package itk-rtk) is not installed", allow_module_level=True)
RTK = itk.RTK

SAD, SDD, DET_SHAPE, PIXEL_MM, OFFSET_MM = 404.0, 538.0, (64, 80), 2.0, (3.0, 2.0)  # offsets along v, u
ANGLES = range(0, 360, 4)
COUNT, SPACING_MM = 40, 2.0
SOLIDS = [
    (Sphere(torch.tensor([0.0, 0.0, 0.0]), 36.0), 0.02),
    (Sphere(torch.tensor([12.0, -9.0, 8.0]), 8.0), 0.02),
    (Sphere(torch.tensor([-15.0, 6.0, -10.0]), 6.0), -0.01),
]


def image(values, spacing):
    made = itk.image_from_array(np.ascontiguousarray(values, dtype=np.float32))
    made.SetSpacing(spacing)
    made.SetOrigin([-(n - 1) / 2 * d for n, d in zip(values.shape[::-1], spacing, strict=True)])
    return made


def rtk_fdk(images):
    """RTK's volume (z, y, x) in our axes: it turns about y, its x, y, z are our y, z, x."""
    circle = RTK.ThreeDCircularProjectionGeometry.New()
    for angle in ANGLES:
        circle.AddProjection(SAD, SDD, float(angle), OFFSET_MM[1], OFFSET_MM[0])
    kind = itk.Image[itk.F, 3]
    run = RTK.FDKConeBeamReconstructionFilter[kind].New()
    run.SetInput(0, image(np.zeros((COUNT,) * 3), (SPACING_MM,) * 3))
    run.SetInput(1, image(images.numpy(), (PIXEL_MM, PIXEL_MM, 1.0)))
    run.SetGeometry(circle)
    run.Update()
    return torch.from_numpy(itk.array_from_image(run.GetOutput())).permute(1, 2, 0)


def test_fdk_is_that_of_rtk(line_integrals_of):
    geometry = circular_geometry(
        ANGLES, sad=SAD, sdd=SDD, det_shape=DET_SHAPE, pixel_spacing=(PIXEL_MM, PIXEL_MM), det_offset_mm=OFFSET_MM
    )
    images = line_integrals_of(SOLIDS, geometry)
    grid = VolumeGrid.centered((COUNT,) * 3, SPACING_MM)
    ours = fdk(images, geometry, grid, config=FDKConfig(extrapolate=False))
    inside = grid.points().norm(dim=-1) < 34
    theirs = rtk_fdk(images)
    assert theirs[inside].mean() == pytest.approx(0.02, rel=0.05)
    assert (ours - theirs)[inside].square().mean().sqrt() < 1e-4 * theirs[inside].square().mean().sqrt()

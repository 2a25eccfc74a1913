"""The voxel projector beside RTK's Joseph projector and its FDK back-projection, where itk-rtk is installed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.projector import backproject, backproject_weighted, project_volume

itk = pytest.importorskip("itk", reason="RTK (package itk-rtk) is not installed")
if not hasattr(itk, "RTK"):
    pytest.skip("RTK (package itk-rtk) is not installed", allow_module_level=True)
RTK = itk.RTK

ANGLES, SAD, SDD = (0.0, 20.0, 45.0, 100.0, 250.0), 404.0, 538.0
DET_SHAPE, PIXEL_SPACING, OFFSET = (40, 48), (2.1, 2.4), (11.0, -7.0)  # (v, u)
COUNTS, SPACING, CENTER = (20, 24, 28), (2.0, 1.5, 2.5), (4.0, -3.0, 5.0)


def image(values, spacing, middle):
    made = itk.image_from_array(np.ascontiguousarray(values, dtype=np.float32))
    made.SetSpacing(spacing)
    made.SetOrigin([m - (n - 1) / 2 * d for m, n, d in zip(middle, values.shape[::-1], spacing)])
    return made


def rtk(method, first, second):
    """RTK turns about y: its x, y, z are our y, z, x; its detector is moved, not the image."""
    circle = RTK.ThreeDCircularProjectionGeometry.New()
    for angle in ANGLES:
        circle.AddProjection(SAD, SDD, angle, OFFSET[1], OFFSET[0])
    kind = itk.Image[itk.F, 3]
    made = getattr(RTK, method)
    run = made[kind, kind].New()
    run.SetInput(0, first)
    run.SetInput(1, second)
    run.SetGeometry(circle)
    run.Update()
    return torch.from_numpy(itk.array_from_image(run.GetOutput()))


def scene():
    geometry = circular_geometry(
        ANGLES, sad=SAD, sdd=SDD, det_shape=DET_SHAPE, pixel_spacing=PIXEL_SPACING, det_offset_mm=OFFSET
    )
    return geometry.projection_matrices, VolumeGrid.centered(COUNTS, SPACING, center=CENTER)


def solid(volume):
    """Ours (z, y, x) as RTK's (x, z, y)."""
    return image(
        volume.permute(2, 0, 1).numpy(), (SPACING[1], SPACING[2], SPACING[0]), (CENTER[1], CENTER[2], CENTER[0])
    )


def stack(images):
    return image(images.numpy(), (PIXEL_SPACING[1], PIXEL_SPACING[0], 1.0), (0.0, 0.0, (len(ANGLES) - 1) / 2))


def relative(values, truth):
    return float((values - truth).norm() / truth.norm())


def test_projections_are_those_of_rtk():
    matrices, grid = scene()
    volume = torch.zeros(COUNTS)
    volume[2:-2, 2:-2, 2:-2] = torch.rand(16, 20, 24, generator=torch.Generator().manual_seed(0))
    theirs = rtk("JosephForwardProjectionImageFilter", stack(torch.zeros(len(ANGLES), *DET_SHAPE)), solid(volume))
    assert relative(project_volume(volume, grid, matrices, DET_SHAPE), theirs) < 1e-4


@pytest.mark.parametrize(
    "function, method",
    [(backproject, "JosephBackProjectionImageFilter"), (backproject_weighted, "FDKBackProjectionImageFilter")],
)
def test_backprojections_are_those_of_rtk(function, method):
    matrices, grid = scene()
    images = torch.rand(len(ANGLES), *DET_SHAPE, generator=torch.Generator().manual_seed(1))
    theirs = rtk(method, solid(torch.zeros(COUNTS)), stack(images)).permute(1, 2, 0)
    ours = function(images, grid, matrices)
    inside = (slice(2, -2),) * 3  # RTK's values at the border are others: it clamps
    if function is backproject_weighted:  # RTK weights by (SAD / depth)^2
        ours = ours * SAD**2
    assert relative(ours[inside], theirs[inside]) < 1e-4

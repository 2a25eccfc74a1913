"""Compares every Triton kernel with the reference of its operator, on a GPU or, interpreted, on the CPU.

Run in a process of its own: Triton reads TRITON_INTERPRET when it is first imported.
"""

import os
import sys

import torch

DEVICE = sys.argv[1]
if DEVICE == "cpu":
    os.environ["TRITON_INTERPRET"] = "1"

from torchkcreg.geometry import VolumeGrid, circular_geometry  # noqa: E402
from torchkcreg.kernels.gpu import KERNELS  # noqa: E402
from torchkcreg.physics import blur as blur_module  # noqa: E402
from torchkcreg.physics import transmission as transmission_module  # noqa: E402,F401
from torchkcreg.projector import cell_footprint, point_ops, voxel_ops, voxels  # noqa: E402
from torchkcreg.splines import ControlPointGrid  # noqa: E402
from torchkcreg.splines import basis as basis_module  # noqa: E402
from torchkcreg.splines.basis import SplineBasis  # noqa: E402

OPERATORS = {
    operator.name: operator
    for module in (blur_module, sys.modules["torchkcreg.physics.transmission"], point_ops, voxel_ops, basis_module)
    for operator in vars(module).values()
    if type(operator).__name__ == "Operator"
}
GENERATOR = torch.Generator().manual_seed(0)


def random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=GENERATOR, dtype=torch.float64).to(DEVICE)


def compare(name: str, *inputs: object) -> None:
    """Asserts that a kernel gives what the definition gives."""
    found, expected = KERNELS[name](*inputs), OPERATORS[name].reference(*inputs)
    for number, (a, b) in enumerate(zip(*((x if isinstance(x, tuple) else (x,)) for x in (found, expected)))):
        torch.testing.assert_close(
            a, b, rtol=1e-9, atol=1e-11, msg=lambda text, n=number: f"{name}, result {n}: {text}"
        )
    print(name, "is its reference", flush=True)


def of_points() -> None:
    """Nodes inside, across the border, behind the source, and one that is nowhere."""
    geometry = circular_geometry([0, 70], sad=404, sdd=538, det_shape=(14, 12), pixel_spacing=(4.0, 4.0))
    points = (random(2, 150, 3) - 0.5) * torch.tensor([40.0, 60.0, 60.0], dtype=torch.float64, device=DEVICE)
    points[0, 3] = torch.nan
    points[1, 5] = 5000.0
    matrices = geometry.projection_matrices.to(DEVICE)
    cell = 3.0 * torch.eye(3, dtype=torch.float64, device=DEVICE)
    footprint = cell_footprint(points, cell, matrices, block_size=64, phases=4)
    volumes, shape = random(150), (14, 12)
    compare("point_drr", points, volumes, matrices, footprint.table, 64, *shape)
    points = points.nan_to_num(1000.0)  # gradients of nodes that are nowhere are not compared
    for needed in ((True, True), (False, False)):
        compare("point_drr_backward", random(2, 2, *shape), points, volumes, matrices, footprint.table, 64, *needed)


def of_transmission() -> None:
    """Two candidates and materials, three views, spectra of their own; kernels that are not symmetric."""
    for taps, pooling in ((1, 1), (5, 2)):
        inputs = 3 * random(2, 2, 3, 6, 8), 0.5 * random(2, 4), random(2, 3, 4), random(2, taps), pooling
        compare("transmission", *inputs)
        for needed in (True, False):
            compare("transmission_backward", random(2, 3, 6 // pooling, 8 // pooling), *inputs, needed)


def of_blur() -> None:
    """Kernels narrower and wider than the images."""
    for shape in ((2, 5, 7), (1, 1, 9), (3, 20, 1)):
        for transposed in (False, True):
            compare("blur", random(*shape), random(11), transposed)


def of_splines() -> None:
    """All orders of the derivative."""
    grid = ControlPointGrid((5, 6, 7), (2.0, 3.0, 4.0), torch.eye(4, dtype=torch.float64, device=DEVICE))
    basis = SplineBasis(grid, 8 * random(200, 3))
    features = random(len(basis.cells), 64, 3)
    for orders in ((0, 0, 0), (1, 2, 3), (4, 0, 1)):
        compare("spline_evaluate", basis.eta, features, basis._sorted.order, basis._sorted.ends, *orders)


def of_voxels() -> None:
    """Steep rays, a tilted detector, a source inside the volume, pixels beside it."""
    for angles, spacing, shift in (((0, 50, 200), 4.0, 0.0), ((0, 30), 14.0, 380.0)):
        views = circular_geometry(angles, sad=404, sdd=538, det_shape=(9, 11), pixel_spacing=(spacing, spacing))
        tilt = torch.tensor([[1.0, 0.05, 0.0], [-0.05, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        middle = (shift, 0.0, 0.3 * shift)
        grid = VolumeGrid.centered((5, 6, 7), (4.0, 5.0, 6.0), center=middle)
        rays, step = voxels._rays(grid, (tilt @ views.projection_matrices).to(DEVICE), random(1))
        volume, images = random(2, 5, 6, 7), random(2, len(angles), 9, 11)
        compare("voxel_project", volume, rays, step, 9, 11)
        compare("voxel_backproject", images, rays, step, 5, 6, 7)
        matrices = (tilt @ views.projection_matrices @ grid.voxel_to_world).to(DEVICE)
        compare("voxel_backproject_weighted", images, matrices, 5, 6, 7)


for check in (of_points, of_transmission, of_blur, of_splines, of_voxels):
    check()
print("all kernels are their references")

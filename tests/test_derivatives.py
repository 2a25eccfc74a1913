"""Every operator in every way that torch differentiates: right values, on every backend."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import trimesh
from torch import Tensor

from torchkcreg.deformation import FreeFormDeformation
from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import PolyenergeticTransmission, material, tungsten_spectrum
from torchkcreg.projector import PointCloudProjector, VolumeProjector, cell_footprint, project_mesh
from torchkcreg.similarity import gradient_correlation
from torchkcreg.splines import default_grid

GEOMETRY = circular_geometry([0, 70], sad=404, sdd=538, det_shape=(14, 12), pixel_spacing=(4.0, 4.0))
CLOUD = ImplantPointCloud.from_mesh(trimesh.creation.box((7.3, 11.1, 17.7)), pitch=3.0)
POINTS, VOLUMES = CLOUD.points.double(), CLOUD.volumes.double()
TURN = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)


def points_of(backend: str) -> Callable[[Tensor], Tensor]:
    projector = PointCloudProjector(GEOMETRY, backend=backend)
    footprint = cell_footprint(POINTS, CLOUD.cell.double(), GEOMETRY.projection_matrices)  # its shape is a constant
    return lambda x: projector(POINTS * (1 + 0.05 * x) + x, VOLUMES, footprint=footprint)


def volume_of(backend: str) -> Callable[[Tensor], Tensor]:
    grid = VolumeGrid.centered((3, 4, 5), 4.0)
    projector = VolumeProjector(GEOMETRY, grid, backend=backend)
    parts = torch.rand(3, *grid.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return lambda x: projector((x[:, None, None, None] * parts).sum(0))


def adjoint_of(backend: str) -> Callable[[Tensor], Tensor]:
    projector = VolumeProjector(GEOMETRY, VolumeGrid.centered((3, 4, 5), 4.0), backend=backend)
    parts = torch.rand(3, 2, 14, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return lambda x: projector.adjoint((x[:, None, None, None] * parts).sum(0))


def intensity_of(_: str) -> Callable[[Tensor], Tensor]:
    model = PolyenergeticTransmission([material("steel"), material("soft_tissue")], tungsten_spectrum(90), num_bins=4)
    lengths = torch.rand(2, 1, 6, 8, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def function(x: Tensor) -> Tensor:
        physics = {"scatter": 0.2 + 0.05 * x[0], "blur_sigma_px": 0.7 + 0.1 * x[1], "hardness": x[2]}
        return model(lengths * (2 + x[1]), pooling=2, **physics)

    return function


def mesh_of(backend: str) -> Callable[[Tensor], Tensor]:
    box = trimesh.creation.box((7.3, 11.1, 17.7))
    vertices, faces = torch.tensor(box.vertices), torch.tensor(box.faces)
    return lambda x: project_mesh(
        vertices + x, faces, GEOMETRY.projection_matrices, GEOMETRY.det_shape, backend=backend
    )


def similarity_of(_: str) -> Callable[[Tensor], Tensor]:
    fixed, *parts = torch.rand(4, 2, 9, 8, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    return lambda x: gradient_correlation(fixed + sum(w * p for w, p in zip(x, parts)), fixed)


def deformation_of(_: str) -> Callable[[Tensor], Tensor]:
    deformation = FreeFormDeformation(default_grid(POINTS)).double()
    with torch.no_grad():
        deformation.control_points.normal_(generator=torch.Generator().manual_seed(5))
    return lambda x: deformation.displacement(POINTS[:20] + x)


CASES = [
    *(
        (name, build, backend)
        for name, build in (("points", points_of), ("volume", volume_of), ("adjoint", adjoint_of), ("mesh", mesh_of))
        for backend in ("cpp", "torch")
    ),
    ("intensity", intensity_of, "auto"),
    ("similarity", similarity_of, "auto"),
    ("deformation", deformation_of, "auto"),
]
SMOOTH = ("volume", "adjoint", "intensity", "similarity", "deformation")  # footprints and pixels' edges make kinks
every_operator = pytest.mark.parametrize(("name", "build", "backend"), CASES, ids=[f"{n}-{b}" for n, _, b in CASES])


def slopes(function: Callable[[Tensor], Tensor], step: float = 1e-5) -> Tensor:
    """Central differences (..., 3)."""
    steps = step * torch.eye(3, dtype=torch.float64)
    return torch.stack([(function(TURN + s) - function(TURN - s)) / (2 * step) for s in steps], dim=-1)


@every_operator
def test_first_derivatives_in_either_mode(name, build, backend):
    function = build(backend)
    expected = slopes(function)
    scale = float(expected.abs().max())
    assert scale > 0
    close = {"rtol": 1e-4, "atol": 1e-5 * scale}
    direction = torch.tensor([0.2, 1.0, -0.4], dtype=torch.float64)
    tangent = torch.func.jvp(function, (TURN,), (direction,))[1]
    torch.testing.assert_close(tangent, expected @ direction, **close)
    torch.testing.assert_close(torch.func.jacrev(function, chunk_size=1)(TURN), expected, **close)
    torch.testing.assert_close(torch.func.jacfwd(function)(TURN), expected, **close)
    upstream = torch.rand(expected.shape[:-1], generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    wanted = (expected * upstream[..., None]).flatten(0, -2).sum(0)
    torch.testing.assert_close(torch.func.vjp(function, TURN)[1](upstream)[0], wanted, rtol=1e-4, atol=1e-4 * scale)
    with torch.autograd.forward_ad.dual_level():
        dual = function(torch.autograd.forward_ad.make_dual(TURN, direction))
        torch.testing.assert_close(torch.autograd.forward_ad.unpack_dual(dual).tangent, tangent)


@every_operator
def test_second_derivatives(name, build, backend):
    """The Gauss-Newton part is exact everywhere; the rest where the operator has no kinks."""
    function = build(backend)

    def energy(x: Tensor) -> Tensor:
        return function(x).square().sum()

    hessian = torch.autograd.functional.hessian(energy, TURN)
    tolerance = 1e-6 if name == "mesh" else 1e-8  # its fast gradient and its reference's have quadratures of their own
    other = torch.func.jacfwd(torch.func.grad(energy))(TURN)
    torch.testing.assert_close(other, hessian, rtol=tolerance, atol=tolerance)
    if name in SMOOTH:
        expected = slopes(torch.func.grad(energy))
        torch.testing.assert_close(hessian, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    else:
        jacobian = slopes(function).flatten(0, -2)
        gauss_newton = 2 * jacobian.T @ jacobian
        assert float((hessian - gauss_newton).norm()) < 2 * float(gauss_newton.norm()) and float(hessian.norm()) > 0


@pytest.mark.parametrize("build", [points_of, volume_of, adjoint_of, similarity_of])
def test_batches_of_vmap_are_those_of_a_loop(build):
    function = build("cpp")
    batch = torch.stack([TURN, -TURN, 2 * TURN])
    torch.testing.assert_close(torch.func.vmap(function)(batch), torch.stack([function(x) for x in batch]))
    gradient = torch.func.grad(lambda x: function(x).square().sum())
    torch.testing.assert_close(torch.func.vmap(gradient)(batch), torch.stack([gradient(x) for x in batch]))


def test_what_depends_on_the_data_refuses_a_batch_of_vmap():
    """How wide a blur is, which cell a point lies in, which pixels a triangle meets: shapes that differ in a batch."""
    batch = torch.stack([TURN, -TURN])
    for build in (intensity_of, deformation_of, mesh_of):
        with pytest.raises(RuntimeError, match="vmap"):
            torch.func.vmap(build("auto"))(batch)


def test_path_lengths_of_an_intensity_may_be_a_batch_of_vmap():
    model = PolyenergeticTransmission([material("steel")], tungsten_spectrum(90), scatter=0.1, blur_sigma_px=0.8)
    lengths = torch.rand(3, 1, 2, 6, 8, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    gradient = torch.func.grad(lambda x: model(x).square().sum())
    torch.testing.assert_close(torch.func.vmap(gradient)(lengths), torch.stack([gradient(x) for x in lengths]))


@every_operator
def test_autocast_changes_nothing(name, build, backend):
    function = build(backend)
    expected = function(TURN)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(function(TURN), expected)


def test_what_autocast_made_of_half_precision_is_computed_in_single():
    images = torch.rand(1, 2, 8, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert gradient_correlation(images.bfloat16(), images[0]).dtype == torch.float32

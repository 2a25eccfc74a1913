"""The method in one file, `examples/kcreg_in_one_file.py`, gives what the library gives."""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import trimesh

from torchkcreg.deformation import FreeFormDeformation, diffusion_penalty
from torchkcreg.geometry import circular_geometry
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import write_geometry, write_mesh, write_points, write_projections
from torchkcreg.projector import project_points
from torchkcreg.similarity import gradient_correlation
from torchkcreg.splines import ControlPointGrid

SOURCE = Path(__file__).resolve().parent.parent / "examples" / "kcreg_in_one_file.py"
if not SOURCE.is_file():
    pytest.skip("the package is installed without its examples", allow_module_level=True)
ONE = runpy.run_path(str(SOURCE))


@pytest.fixture(scope="module")
def plate():
    """Nodes of a small plate at 1 mm, turned, and its grid."""
    mesh = trimesh.creation.box((12.0, 4.0, 60.0))
    cloud = ImplantPointCloud.from_mesh(mesh, pitch=1.0, dtype=torch.float64)
    return cloud.points, ONE["Grid"](cloud.points, (8.0, 8.0, 15.0))


def in_the_library(grid) -> ControlPointGrid:
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, 3] = grid.origin
    return ControlPointGrid(grid.shape, tuple(grid.spacing.tolist()), frame)


def test_it_is_short_and_does_not_import_the_package():
    text = SOURCE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 300
    tree = ast.walk(ast.parse(text))
    names = {n.module.split(".")[0] for n in tree if isinstance(n, ast.ImportFrom)}
    names |= {alias.name for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Import) for alias in n.names}
    outside = {name for name in names if name not in sys.stdlib_module_names}
    assert outside == {"torch", "kornia", "numpy", "cma"}


def test_its_deformation_is_the_librarys(plate):
    points, grid = plate
    phi = torch.rand(len(grid.positions), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    library = FreeFormDeformation(in_the_library(grid), phi.unflatten(0, grid.shape))
    torch.testing.assert_close(grid.weights(points) @ phi, library.displacement(points), rtol=0, atol=1e-10)


def test_its_groups_move_rigidly(plate):
    points, grid = plate
    groups = ONE["Groups"](grid, 1)
    steps = torch.tensor([[[0.6, -0.9, 0.3, 1.0, 2.0, -1.0]]], dtype=torch.float64)
    moved = points + grid.weights(points) @ groups.control_points(steps)[0]
    torch.testing.assert_close(moved, groups.rigid(points, steps)[0], rtol=0, atol=1e-9)


def test_a_split_of_its_groups_changes_nothing(plate):
    _, grid = plate
    two, four = ONE["Groups"](grid, 2), ONE["Groups"](grid, 4)
    steps = torch.rand(2, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    split = four.split_from(two, steps)
    torch.testing.assert_close(four.control_points(split[None]), two.control_points(steps[None]), rtol=0, atol=1e-12)


def test_its_penalty_is_the_librarys(plate):
    _, grid = plate
    phi = torch.rand(2, len(grid.positions), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    library = diffusion_penalty(phi.unflatten(1, grid.shape), in_the_library(grid), remove_rigid=False)
    torch.testing.assert_close(ONE["diffusion_penalty"](phi, grid), library)


def test_its_gradient_correlation_is_the_librarys():
    generator = torch.Generator().manual_seed(3)
    moving, fixed = torch.rand(2, 3, 24, 20, generator=generator), torch.rand(3, 24, 20, generator=generator)
    torch.testing.assert_close(ONE["gradient_correlation"](moving, fixed), gradient_correlation(moving, fixed))


def test_its_drr_is_the_librarys():
    mesh = trimesh.creation.box((20.0, 8.0, 40.0))
    cloud = ImplantPointCloud.from_mesh(mesh, pitch=0.5, dtype=torch.float64)
    turned = torch.tensor(trimesh.transformations.rotation_matrix(0.5, [1, 2, 3])[:3, :3])
    points = cloud.points @ turned.T
    views = circular_geometry([0, 40, 90], sad=404, sdd=538, det_shape=(80, 70), pixel_spacing=(1.0, 1.0))
    matrices = views.projection_matrices.double()
    library = project_points(points, cloud.volumes, matrices, (80, 70), cell=cloud.cell @ turned.T)
    ours = ONE["project"](points[None], 0.125, matrices, (80, 70))[0]
    assert library.max() > 8
    assert float((ours - library).square().mean().sqrt() / library.max()) < 0.01
    torch.testing.assert_close(ours.sum((1, 2)), library.sum((1, 2)), rtol=2e-3, atol=0)


@pytest.mark.parametrize("optimizer", ["adam", "cma"])
def test_it_finds_how_a_plate_bent(optimizer, tmp_path):
    mesh = trimesh.creation.box((12.0, 4.0, 80.0))
    mesh.apply_translation([1.0, 2.0, 3.0])
    cloud = ImplantPointCloud.from_mesh(mesh, pitch=0.5, dtype=torch.float64)
    beads = torch.tensor([[1.0, 8.0, -35.0], [1.0, 8.0, 41.0], [9.0, 2.0, 3.0]], dtype=torch.float64)

    def bent(points: torch.Tensor) -> torch.Tensor:
        x, y, z = points.unbind(-1)
        return torch.stack([x + 0.4, y + 1.5 * ((z - 3) / 40) ** 2, z - 0.3], dim=-1)

    views = circular_geometry([0, 50, 100], sad=404, sdd=538, det_shape=(128, 40), pixel_spacing=(1.0, 1.0))
    lengths = project_points(
        bent(cloud.points), cloud.volumes, views.projection_matrices.double(), (128, 40), cell=cloud.cell
    )
    write_mesh(tmp_path / "implant.stl", mesh)
    write_geometry(tmp_path / "geometry.json", views)
    write_projections(tmp_path / "projections.npz", intensity=1e5 * torch.exp(-0.05 * lengths), open_beam=1e5)
    write_points(tmp_path / "beads_before.csv", beads)
    write_points(tmp_path / "beads_after.csv", bent(beads))
    iterations = {"adam": "80", "cma": "60"}[optimizer]
    options = ["--optimizer", optimizer, "--pitch", "2", "--bin", "1", "--groups", "2", "--iterations", iterations]
    run = subprocess.run([sys.executable, SOURCE, tmp_path, *options], capture_output=True, text=True, check=True)
    start, end = (float(line.split()[2]) for line in run.stdout.splitlines()[-2:])
    assert start > 1.0
    assert end < 0.4

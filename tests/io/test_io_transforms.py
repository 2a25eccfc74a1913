import pytest
import SimpleITK as sitk
import torch

from torchkcreg.deformation import FreeFormDeformation
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.io import displacement_field, itk_transform, write_displacement_field, write_itk_transform
from torchkcreg.splines import ControlPointGrid


def random(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def pose():
    return rigid_matrix(torch.tensor([0.3, -0.5, 0.9]), torch.tensor([12.0, -30.0, 55.0])).double()


@pytest.fixture
def deformation():
    """Unlike numbers of control points and spacings, turned axes, random displacements."""
    frame = rigid_matrix(torch.tensor([1.2, 0.4, -0.7]).double(), torch.tensor([-14.0, 33.0, 8.0]).double())
    shape = (5, 6, 8)
    labels = (torch.arange(8) // 4).expand(shape)
    return FreeFormDeformation(ControlPointGrid(shape, (8.75, 6.0, 25.0), frame), 2 * random(*shape, 3), labels)


def inside(deformation, num=400):
    """Points spread over the grid's valid domain, its corners nearly included, in the implant's frame."""
    share = torch.rand(num, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    share[:8] = torch.cartesian_prod(*[torch.tensor([1e-6, 1 - 1e-6], dtype=torch.float64)] * 3)
    grid = deformation.grid
    spacing = torch.tensor(grid.spacing, dtype=torch.float64)
    spans = torch.tensor(grid.shape, dtype=torch.float64) - 3
    return transform_points(grid.frame, (1 + share * spans) * spacing)


def by_itk(transform, points):
    return torch.tensor([transform.TransformPoint(point) for point in points.tolist()], dtype=torch.float64)


def test_the_itk_transform_moves_points_as_the_deformation_does(pose, deformation):
    points = inside(deformation)
    assert deformation.grid.contains(points).all()
    ours = transform_points(pose, deformation(points))
    torch.testing.assert_close(by_itk(itk_transform(pose, deformation), points), ours, rtol=0, atol=1e-9)


def test_the_itk_transform_is_the_same_after_a_file(tmp_path, pose, deformation):
    write_itk_transform(tmp_path / "bspline.tfm", pose, deformation)
    points = inside(deformation)
    ours = transform_points(pose, deformation(points))
    read = sitk.ReadTransform(str(tmp_path / "bspline.tfm"))
    torch.testing.assert_close(by_itk(read, points), ours, rtol=0, atol=1e-6)
    assert [entry.name for entry in tmp_path.iterdir()] == ["bspline.tfm"]


def test_without_displacements_the_itk_transform_is_the_pose(pose, deformation):
    with torch.no_grad():
        deformation.control_points.zero_()
    points = inside(deformation)
    moved = by_itk(itk_transform(pose, deformation), points)
    torch.testing.assert_close(moved, transform_points(pose, points), rtol=0, atol=1e-10)


def test_a_single_precision_deformation_is_written_as_well(pose, deformation):
    points = inside(deformation)
    ours = transform_points(pose, deformation.float()(points))
    torch.testing.assert_close(by_itk(itk_transform(pose, deformation), points), ours, rtol=0, atol=1e-4)


def test_each_voxel_of_the_field_leads_where_the_deformation_leads_also_beyond_the_grid(pose, deformation):
    field = displacement_field(pose, deformation, inside(deformation), spacing_mm=9.0, margin_mm=20.0)
    indices = [(0, 0, 0), (1, 2, 3), (3, 1, 9), tuple(n - 1 for n in field.GetSize())]
    points = torch.tensor([field.TransformIndexToPhysicalPoint(index) for index in indices], dtype=torch.float64)
    vectors = torch.tensor([field[index] for index in indices], dtype=torch.float64)
    assert not deformation.grid.contains(points).all()
    torch.testing.assert_close(points + vectors, transform_points(pose, deformation(points)), rtol=0, atol=1e-5)


def test_the_field_covers_the_valid_domain_and_its_margin(pose, deformation):
    field = displacement_field(pose, deformation, inside(deformation), spacing_mm=3.0, margin_mm=7.0)
    assert max(field.GetSpacing()) <= 3.0
    reached = [(n - 1) * s for n, s in zip(field.GetSize(), field.GetSpacing())]
    assert reached == pytest.approx([2 * 8.75 + 14, 3 * 6.0 + 14, 5 * 25.0 + 14])
    corner = torch.tensor([[8.75 - 7, 6.0 - 7, 25.0 - 7]], dtype=torch.float64)
    assert field.GetOrigin() == pytest.approx(transform_points(deformation.grid.frame, corner)[0].tolist())


def test_a_field_from_a_file_moves_points_as_the_deformation_does(tmp_path, pose, deformation):
    with torch.no_grad():
        deformation.control_points.mul_(0.2)
    write_displacement_field(tmp_path / "dvf.mha", pose, deformation, inside(deformation))
    image = sitk.ReadImage(str(tmp_path / "dvf.mha"), sitk.sitkVectorFloat64)
    points = inside(deformation, 100)
    moved = by_itk(sitk.DisplacementFieldTransform(image), points)
    # linear interpolation between voxels 2 mm apart: h^2 / 8 times the curvature of the spline
    torch.testing.assert_close(moved, transform_points(pose, deformation(points)), rtol=0, atol=0.05)


def test_writing_leaves_the_deformation_as_it_was(tmp_path, pose, deformation):
    deformation.float()
    before = deformation.control_points.detach().clone()
    write_displacement_field(tmp_path / "dvf.mha", pose, deformation, inside(deformation))
    write_itk_transform(tmp_path / "bspline.tfm", pose, deformation)
    assert deformation.control_points.dtype == torch.float32
    assert torch.equal(deformation.control_points, before)

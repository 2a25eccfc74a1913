"""The free-form deformation."""

import pytest
import SimpleITK as sitk
import torch

from torchkcreg.deformation import FreeFormDeformation, cluster_control_points, control_points_from_groups
from torchkcreg.geometry import rigid_matrix, rotation_from_vector, transform_points
from torchkcreg.splines import ControlPointGrid, group_rigid_motions, spline_displacement

POSE = rigid_matrix(
    torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([30.0, -5.0, 11.0], dtype=torch.float64)
)
GRID = ControlPointGrid((6, 5, 8), (8.75, 7.0, 25.0), POSE)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def phi(scale=2.0, seed=0):
    return scale * (random(*GRID.shape, 3, seed=seed) - 0.5)


def points_in(low, high, count=100):
    """Points whose grid coordinates lie between two multiples of (n - 1) spacings."""
    size = GRID.positions()[-1, -1, -1]
    return transform_points(POSE, (low + (high - low) * random(count, 3, seed=3)) * size)


def inside(count=100):
    return points_in(0.26, 0.70, count)


def halves():
    labels = torch.zeros(GRID.shape, dtype=torch.long)
    labels[:, :, 4:] = 1
    return labels


def rigid_phi(motion):
    positions = GRID.positions().reshape(-1, 3)
    return (transform_points(motion, positions) - positions).reshape(*GRID.shape, 3)


MOTION = rigid_matrix(torch.tensor([0.3, -0.2, 0.5]).double(), torch.tensor([3.0, 1.0, -7.0]).double())


def test_a_new_deformation_moves_nothing():
    points = points_in(-1, 2)
    assert torch.allclose(FreeFormDeformation(GRID)(points), points, atol=1e-12)


def test_it_agrees_with_simpleitk_in_the_valid_domain():
    control_points = phi(5.0)
    itk = sitk.BSplineTransform(3, 3)
    axes, spacing = POSE[:3, :3], torch.tensor(GRID.spacing, dtype=torch.float64)
    itk.SetTransformDomainOrigin((POSE[:3, 3] + axes @ spacing).tolist())  # ITK's domain starts at our CP 1
    itk.SetTransformDomainDirection(axes.flatten().tolist())
    itk.SetTransformDomainMeshSize([n - 3 for n in GRID.shape])
    itk.SetTransformDomainPhysicalDimensions([(n - 3) * s for n, s in zip(GRID.shape, GRID.spacing, strict=True)])
    in_world_axes = control_points @ axes.T
    itk.SetParameters(in_world_axes.permute(3, 2, 1, 0).flatten().tolist())
    points = inside(200)
    ours = FreeFormDeformation(GRID, control_points)(points)
    theirs = torch.tensor([itk.TransformPoint(p) for p in points.tolist()], dtype=torch.float64)
    assert torch.allclose(ours, theirs, atol=1e-9)
    assert (ours - points).abs().max() > 0.5


def test_a_rigid_motion_of_all_control_points_is_that_motion_everywhere():
    ffd = FreeFormDeformation(GRID, rigid_phi(MOTION))
    in_implant_frame = POSE @ MOTION @ torch.linalg.inv(POSE)
    points = points_in(-3, 4)
    assert torch.allclose(ffd(points), transform_points(in_implant_frame, points), atol=1e-9)


def test_an_affine_motion_is_reproduced_inside_and_its_determinant_is_exact():
    stretch = torch.diag(torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64))
    ffd = FreeFormDeformation(GRID, GRID.positions() @ stretch)
    points = inside()
    axes = POSE[:3, :3]
    expected = GRID.to_grid(points) @ stretch @ axes.T
    assert torch.allclose(ffd.displacement(points), expected, atol=1e-12)
    determinant = torch.tensor(1.01 * 0.98 * 1.03, dtype=torch.float64)
    assert torch.allclose(ffd.jacobian_determinant(points), determinant, atol=1e-12)


def test_far_beyond_the_grid_each_side_moves_rigidly_with_its_own_group():
    ffd = FreeFormDeformation(GRID, phi(), halves())
    motions = POSE @ group_rigid_motions(GRID, ffd.control_points.detach(), halves()) @ torch.linalg.inv(POSE)
    size = GRID.positions()[-1, -1, -1]
    low = transform_points(POSE, torch.tensor([0.5, 0.5, -3.0]).double() * size + random(20, 3))
    high = transform_points(POSE, torch.tensor([0.5, 0.5, 4.0]).double() * size + random(20, 3))
    assert torch.allclose(ffd(low), transform_points(motions[0], low), atol=1e-9)
    assert torch.allclose(ffd(high), transform_points(motions[1], high), atol=1e-9)


def test_the_field_is_continuous_across_the_border_of_the_valid_domain_and_of_the_grid():
    ffd = FreeFormDeformation(GRID, phi(), halves())
    for z in (25.0, 0.0, -25.0, -50.0, 6 * 25.0, 7 * 25.0):
        pair = torch.tensor([[20.0, 13.0, z - 1e-7], [20.0, 13.0, z + 1e-7]], dtype=torch.float64)
        u = ffd.displacement(transform_points(POSE, pair))
        assert torch.allclose(u[0], u[1], atol=1e-7)


def test_labels_do_not_matter_inside():
    points = inside()
    one, two = FreeFormDeformation(GRID, phi()), FreeFormDeformation(GRID, phi(), halves())
    assert torch.equal(one(points), two(points))


def test_labels_may_skip_numbers():
    points = points_in(-1, 2)
    one, two = FreeFormDeformation(GRID, phi(), halves()), FreeFormDeformation(GRID, phi(), 5 * halves())
    assert torch.equal(one(points), two(points))


@pytest.mark.parametrize("weighted", [False, True])
def test_removing_the_common_rigid_motion_changes_nothing_in_total(weighted):
    groups = cluster_control_points(GRID, torch.ones(GRID.shape), 3)
    ffd = FreeFormDeformation(GRID, rigid_phi(MOTION) + phi(), groups)
    points = points_in(-1, 2)
    before = ffd(points)
    weights = random(*GRID.shape, seed=5) if weighted else None
    common = ffd.remove_common_rigid(weights)
    assert common.shape == (4, 4) and common.dtype == torch.float64
    assert torch.allclose(transform_points(common, ffd(points)), before, atol=1e-9)
    assert torch.allclose(ffd.remove_common_rigid(weights), torch.eye(4).double(), atol=1e-9), "nothing is left"


def test_what_is_rigid_disappears_from_the_control_points():
    ffd = FreeFormDeformation(GRID, rigid_phi(MOTION))
    common = ffd.remove_common_rigid()
    assert torch.allclose(common, POSE @ MOTION @ torch.linalg.inv(POSE), atol=1e-9)
    assert ffd.control_points.abs().max() < 1e-9


def test_weights_choose_whose_motion_is_taken_out():
    labels = halves()
    rotations = rotation_from_vector(torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.2, 0.1]], dtype=torch.float64))
    shifts = torch.tensor([[1.0, 2.0, 3.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    ffd = FreeFormDeformation(GRID, control_points_from_groups(GRID, labels, rotations, shifts), labels)
    ffd.remove_common_rigid((labels == 1).double())
    assert ffd.control_points[labels == 1].abs().max() < 1e-9
    assert ffd.control_points[labels == 0].abs().max() > 1


def test_the_jacobian_is_autograds_inside_and_beyond():
    ffd = FreeFormDeformation(GRID, phi(), halves())
    points = points_in(-0.5, 1.5, 12)
    expected = torch.stack([torch.autograd.functional.jacobian(lambda p: ffd(p[None])[0], p) for p in points])
    assert torch.allclose(ffd.jacobian(points), expected, atol=1e-12)
    assert torch.allclose(ffd.jacobian_determinant(points), torch.linalg.det(expected), atol=1e-12)


def test_gradients_of_points_and_control_points_pass_gradcheck_inside_and_beyond():
    grid = ControlPointGrid((4, 4, 5), (2.0, 3.0, 4.0), POSE)
    labels = torch.zeros(grid.shape, dtype=torch.long)
    labels[:, :, 3:] = 1
    control_points = random(*grid.shape, 3).requires_grad_()
    coordinates = torch.tensor([[3.1, 4.2, 7.7], [-9.0, 4.2, 7.7], [3.1, 30.0, 22.0]], dtype=torch.float64)
    points = transform_points(POSE, coordinates).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, p: spline_displacement(grid, c, p, labels=labels), (control_points, points), fast_mode=True
    )


def test_leading_axes_of_points_and_of_candidates_are_kept():
    candidates = torch.stack([phi(seed=s) for s in range(6)]).reshape(2, 3, *GRID.shape, 3)
    points = points_in(-0.5, 1.5, 20)
    u = spline_displacement(GRID, candidates, points.reshape(4, 5, 3), labels=halves())
    assert u.shape == (2, 3, 4, 5, 3)
    alone = FreeFormDeformation(GRID, candidates[1, 2], halves()).displacement(points)
    assert torch.allclose(u[1, 2].reshape(20, 3), alone, atol=1e-12)
    assert FreeFormDeformation(GRID)(points[0]).shape == (3,)


def test_single_precision_points_give_single_precision_results():
    ffd, points = FreeFormDeformation(GRID, phi()), inside()
    u = ffd.displacement(points.float())
    assert u.dtype == torch.float32
    assert torch.allclose(u.double(), ffd.displacement(points), atol=1e-5)


def test_state_holds_control_points_and_labels():
    ffd = FreeFormDeformation(GRID, phi(), halves())
    other = FreeFormDeformation(GRID)
    other.load_state_dict(ffd.state_dict())
    points = points_in(-1, 2)
    assert torch.equal(other(points), ffd(points))
    assert [name for name, _ in ffd.named_parameters()] == ["control_points"]


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="control_points must have shape"):
        FreeFormDeformation(GRID, torch.zeros(6, 6, 10, 3))
    with pytest.raises(ValueError, match="labels must have shape"):
        FreeFormDeformation(GRID, labels=torch.zeros(6, 6, 10))
    with pytest.raises(ValueError, match="control_points must have shape"):
        spline_displacement(GRID, torch.zeros(6, 6, 10, 3), torch.zeros(1, 3))


def test_a_state_of_another_grid_is_refused_and_one_without_a_grid_is_taken():
    fine, coarse = (ControlPointGrid((6, 6, 10), (8.75, 8.75, step), torch.eye(4)) for step in (17.5, 25.0))
    given = FreeFormDeformation(fine, torch.rand(6, 6, 10, 3))
    same, other = FreeFormDeformation(fine), FreeFormDeformation(coarse)
    same.load_state_dict(given.state_dict())
    assert torch.equal(same.control_points, given.control_points.to(same.control_points))
    with pytest.raises(ValueError, match=r"another grid \(spacing 8.75, 8.75, 17.5 mm\)"):
        other.load_state_dict(given.state_dict())
    older = {name: value for name, value in given.state_dict().items() if "extra" not in name}
    FreeFormDeformation(fine).load_state_dict(older)


def test_no_points_have_no_displacements_for_any_number_of_candidates():
    grid = ControlPointGrid((4, 4, 4), (1.0, 1.0, 1.0), torch.eye(4))
    control_points = torch.ones(2, 5, 4, 4, 4, 3)
    assert spline_displacement(grid, control_points, torch.zeros(7, 0, 3)).shape == (2, 5, 7, 0, 3)

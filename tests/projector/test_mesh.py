"""Path lengths through meshes: boxes, spheres, silhouettes, the detector's border, gradients."""

from __future__ import annotations

import pytest
import torch
import trimesh

from torchkcreg.kernels import unavailable_reason
from torchkcreg.projector.mesh import project_mesh

# source at (0, 0, -500), detector 1000 px behind the source, pixel (15, 15) on the axis; u, v, ray are left-handed
MATRIX = torch.tensor([[-1000.0, 0, 15, 7500], [0, 1000, 15, 7500], [0, 0, 1, 500]], dtype=torch.float64)
TURN = trimesh.transformations.rotation_matrix(0.7, [0.3, 1.0, 0.2])[:3, :3]
OBLIQUE = torch.cat([MATRIX[:, :3] @ torch.from_numpy(TURN), MATRIX[:, 3:]], dim=1)
DET_SHAPE = (31, 31)


def tensors(mesh: trimesh.Trimesh) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(mesh.vertices, dtype=torch.float64), torch.tensor(mesh.faces)


def box_chords(extents: list[float], matrix: torch.Tensor, fine: int) -> torch.Tensor:
    """Chords through a centred box, slab by slab, averaged over fine x fine rays a pixel."""
    sub = (torch.arange(fine, dtype=torch.float64) + 0.5) / fine - 0.5
    v = (torch.arange(DET_SHAPE[0])[:, None] + sub).flatten()
    u = (torch.arange(DET_SHAPE[1])[:, None] + sub).flatten()
    pixels = torch.stack([*torch.meshgrid(u, v, indexing="xy"), torch.ones(len(v), len(u))], dim=-1).double()
    inverse = torch.linalg.inv(matrix[:, :3])
    source, rays = -inverse @ matrix[:, 3], pixels @ inverse.T
    half = torch.tensor(extents, dtype=torch.float64) / 2
    ends = torch.stack([(-half - source) / rays, (half - source) / rays])
    length = (ends.amax(0).amin(-1) - ends.amin(0).amax(-1)).clamp_min(0) * rays.norm(dim=-1)
    return length.reshape(DET_SHAPE[0], fine, DET_SHAPE[1], fine).mean((1, 3))


@pytest.mark.parametrize("matrix", [MATRIX, OBLIQUE], ids=["along", "oblique"])
def test_a_box_casts_its_mean_chords(matrix):
    extents = [5.0, 7.0, 40.0]
    image = project_mesh(*tensors(trimesh.creation.box(extents)), matrix[None], DET_SHAPE)[0]
    expected = box_chords(extents, matrix, fine=64)
    assert expected.max() > 5
    # the rays' own error: one of 64 x 64 rays on the wrong side of an edge changes a pixel by up to chord / 64
    torch.testing.assert_close(image, expected, rtol=0, atol=0.06)
    assert float((image - expected).abs().mean()) < 3e-3


def test_pixels_wholly_inside_a_face_are_exact():
    image = project_mesh(*tensors(trimesh.creation.box([40.0, 40.0, 30.0])), MATRIX[None], DET_SHAPE)[0]
    torch.testing.assert_close(image, box_chords([40.0, 40.0, 30.0], MATRIX, fine=8), rtol=1e-7, atol=0)


def test_finer_triangles_of_the_same_surface_change_nothing():
    box = trimesh.creation.box([5.0, 7.0, 40.0])
    fine = box.subdivide().subdivide().subdivide()
    coarse_image = project_mesh(*tensors(box), OBLIQUE[None], DET_SHAPE)
    torch.testing.assert_close(project_mesh(*tensors(fine), OBLIQUE[None], DET_SHAPE), coarse_image, rtol=0, atol=1e-5)


def test_the_sum_over_pixels_gives_a_small_solids_volume():
    sphere = trimesh.creation.icosphere(2, 0.4)
    sphere.apply_translation([1.0, -2.0, 6.0])
    vertices, faces = tensors(sphere)
    image = project_mesh(vertices, faces, OBLIQUE[None], DET_SHAPE)
    u, v, depth = OBLIQUE[:, :3] @ torch.tensor([1.0, -2.0, 6.0], dtype=torch.float64) + OBLIQUE[:, 3]
    inverse = torch.linalg.inv(OBLIQUE[:, :3])
    distance = (inverse @ torch.stack([u / depth, v / depth, torch.ones_like(u)])).norm()
    expected = sphere.volume * float(torch.linalg.det(OBLIQUE[:, :3]).abs() * distance / depth**2)
    assert float(image.sum()) == pytest.approx(expected, rel=2e-5)


def test_a_sphere_is_as_thick_as_its_diameter_in_the_middle_and_round_around_it():
    image = project_mesh(*tensors(trimesh.creation.icosphere(4, 5.0)), MATRIX[None], DET_SHAPE)[0]
    assert float(image[15, 15]) == pytest.approx(10.0, rel=3e-3)
    torch.testing.assert_close(image, image.T, rtol=0, atol=0.05)
    assert float(image[0].abs().max()) < 1e-9


def test_a_face_in_the_plane_of_the_source_is_no_trouble():
    box = trimesh.creation.box([4.0, 4.0, 10.0])
    box.apply_translation([2.0, 0.0, 0.0])  # the face x = 0 contains the source
    vertices, faces = tensors(box)
    image = project_mesh(vertices.requires_grad_(), faces, MATRIX[None], DET_SHAPE)
    image.sum().backward()
    assert image[0, 15, 15].item() == pytest.approx(5.0, rel=1e-4)  # half the pixel
    assert torch.isfinite(vertices.grad).all()


def test_a_mesh_that_leaves_the_detector_loses_just_that_part():
    vertices, faces = tensors(trimesh.creation.box([9.0, 7.0, 40.0]))
    vertices = vertices + torch.tensor([4.0, -5.0, 0.0], dtype=torch.float64)
    shifted = OBLIQUE.clone()
    shifted[0] += 20 * OBLIQUE[2]
    shifted[1] += 20 * OBLIQUE[2]
    wide = project_mesh(vertices, faces, shifted[None], (71, 71))
    narrow = project_mesh(vertices, faces, OBLIQUE[None], DET_SHAPE)
    assert float(narrow[0, 0].max()) > 1
    torch.testing.assert_close(wide[:, 20:51, 20:51], narrow, rtol=0, atol=1e-9)


def test_a_mesh_beside_the_detector_casts_nothing():
    vertices, faces = tensors(trimesh.creation.box([1.0, 1.0, 1.0]))
    assert float(project_mesh(vertices + 50, faces, MATRIX[None], DET_SHAPE).abs().max()) == 0


def test_an_inside_out_mesh_is_negative_and_mirrored_axes_are_not():
    vertices, faces = tensors(trimesh.creation.box([5.0, 7.0, 9.0]))
    image = project_mesh(vertices, faces, MATRIX[None], DET_SHAPE)
    torch.testing.assert_close(project_mesh(vertices, faces.flip(1), MATRIX[None], DET_SHAPE), -image)
    mirrored = MATRIX.clone()
    mirrored[0] = 30 * MATRIX[2] - MATRIX[0]
    torch.testing.assert_close(project_mesh(vertices, faces, mirrored[None], DET_SHAPE), image.flip(2))


def test_candidates_and_views_are_leading_axes():
    vertices, faces = tensors(trimesh.creation.box([5.0, 7.0, 9.0]))
    candidates = torch.stack([vertices, 1.1 * vertices]).float()
    images = project_mesh(candidates, faces, torch.stack([MATRIX, OBLIQUE]), DET_SHAPE)
    assert images.shape == (2, 2, *DET_SHAPE)
    assert images.dtype == torch.float32
    torch.testing.assert_close(
        images[1, 1].double(), project_mesh(candidates[1].double(), faces, OBLIQUE[None], DET_SHAPE)[0]
    )


def test_vertices_and_matrices_can_be_differentiated_silhouettes_included():
    vertices, faces = tensors(trimesh.creation.box([1.3, 0.9, 2.0]))
    matrix = OBLIQUE.clone()
    matrix[0] -= 12.3 * matrix[2]
    matrix[1] -= 13.2 * matrix[2]  # the box reaches over two borders of a detector of 5 x 5
    weights = torch.rand(5, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))

    def weighted(moved: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        return (project_mesh(moved, faces, seen[None], (5, 5)) * weights).sum()

    assert float(weighted(vertices, matrix)) > 1
    inputs = (vertices.requires_grad_(), matrix.requires_grad_())
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-5, atol=1e-4, rtol=1e-4)


@pytest.fixture(scope="module")
def compiled_kernels():
    if unavailable_reason() is not None:
        pytest.skip("the C++ kernels can be neither loaded nor compiled here")


def both_backends(mesh: trimesh.Trimesh, det_shape: tuple[int, int]) -> list[tuple[torch.Tensor, ...]]:
    """Images and gradients to vertices and matrices, in C++ and in torch."""
    results = []
    for backend in ("cpp", "torch"):
        vertices, faces = tensors(mesh)
        matrices = torch.stack([MATRIX, OBLIQUE]).requires_grad_()
        image = project_mesh(vertices.requires_grad_(), faces, matrices, det_shape, backend=backend)
        weights = torch.rand(image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
        results.append((image.detach(), *torch.autograd.grad((image * weights).sum(), (vertices, matrices))))
    return results


@pytest.mark.usefixtures("compiled_kernels")
@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box([5.0, 7.0, 40.0]),  # corners and edges on pixels' borders, faces of many pixels
        trimesh.creation.icosphere(3, 6.0),
        trimesh.creation.icosphere(4, 0.7),  # many triangles in a pixel
        trimesh.creation.cylinder(0.5, 60.0, transform=trimesh.transformations.rotation_matrix(0.3, [1, 1, 0])),
        trimesh.creation.box([50.0, 3.0, 3.0]),  # longer than the detector
    ],
    ids=["box", "sphere", "small", "rod", "long"],
)
def test_cpp_gives_the_numbers_of_the_reference_and_their_gradients(mesh):
    mesh = mesh.copy()
    mesh.apply_translation([0.31, -0.27, 1.0])
    for shape in ((31, 31), (40, 23)):
        (image, *gradients), (expected, *expected_gradients) = both_backends(mesh, shape)
        assert float(expected.max()) > 0.5
        torch.testing.assert_close(image, expected, rtol=1e-7, atol=1e-9)
        for gradient, truth in zip(gradients, expected_gradients):
            assert float((gradient - truth).norm() / truth.norm()) < 1e-4  # quadrature, where w varies


@pytest.mark.usefixtures("compiled_kernels")
def test_any_number_of_threads_gives_the_same_bits():
    mesh = trimesh.creation.icosphere(4, 6.0)
    many = both_backends(mesh, (95, 64))[0]
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = both_backends(mesh, (95, 64))[0]
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(many, one))


@pytest.mark.usefixtures("compiled_kernels")
def test_forward_and_second_derivatives_are_those_of_the_reference():
    vertices, faces = tensors(trimesh.creation.box([1.3, 0.9, 2.0]))
    render = lambda x, backend: project_mesh(x, faces, OBLIQUE[None], (31, 31), backend=backend).square().sum()  # noqa: E731
    tangent = torch.rand(vertices.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pushed = [torch.func.jvp(lambda x, b=b: render(x, b), (vertices,), (tangent,))[1] for b in ("cpp", "torch")]
    torch.testing.assert_close(*pushed, rtol=1e-6, atol=0)


@pytest.mark.usefixtures("compiled_kernels")
def test_an_edge_on_a_pixels_border_moves_for_one_pixel_alone():
    box = trimesh.creation.box([6.0, 6.0, 10.0])
    box.apply_translation([0.3, 0.2, 0.0])
    fine = box.subdivide()  # the new corners lie in the faces, where moving them along the face changes nothing
    on_front = fine.vertices[:, 2] == -5
    corner = int(((fine.vertices - [0.3, 0.2, -5]) ** 2).sum(1).argmin())
    assert on_front[corner]
    vertices, faces = tensors(fine)
    depth = 495.0
    shift = torch.tensor([0.3, 0.2], dtype=torch.float64) - 0.5 / 1000 * depth  # puts that corner between two pixels
    vertices[:, :2] -= shift
    vertices.requires_grad_()
    weights = torch.rand(31, 31, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    image = project_mesh(vertices, faces, MATRIX[None], DET_SHAPE)[0]
    (gradient,) = torch.autograd.grad((image * weights).sum(), vertices)
    assert float(gradient[corner, :2].abs().max()) < 1e-6 * float(gradient.abs().max())


def test_a_moving_silhouette_changes_the_sum_as_its_area():
    vertices, faces = tensors(trimesh.creation.box([4.0, 4.0, 10.0]))
    width = torch.ones((), dtype=torch.float64, requires_grad=True)
    scale = torch.stack([width, torch.ones_like(width), torch.ones_like(width)])
    total = project_mesh(vertices * scale, faces, MATRIX[None], DET_SHAPE).sum()
    (slope,) = torch.autograd.grad(total, width)
    assert slope.item() == pytest.approx(total.item(), rel=2e-3)


def test_wrong_input_is_refused():
    vertices, faces = tensors(trimesh.creation.box([1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="in front of the source"):
        project_mesh(vertices - torch.tensor([0.0, 0.0, 500.0]), faces, MATRIX[None], DET_SHAPE)
    with pytest.raises(ValueError, match="faces must index 8 vertices"):
        project_mesh(vertices, faces + 1, MATRIX[None], DET_SHAPE)
    with pytest.raises(ValueError, match="vertices must have shape"):
        project_mesh(vertices[:, :2], faces, MATRIX[None], DET_SHAPE)
    with pytest.raises(ValueError, match="projection_matrices must have shape"):
        project_mesh(vertices, faces, MATRIX, DET_SHAPE)
    with pytest.raises(ValueError, match="det_shape"):
        project_mesh(vertices, faces, MATRIX[None], (0, 5))

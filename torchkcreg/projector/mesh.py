"""Path lengths through closed triangle meshes, averaged exactly over each pixel, and their kernel operators."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.kernels import Operator, choose_backend
from torchkcreg.kernels.differentiable import differentiable
from torchkcreg.precision import full_precision

from .mesh_reference import integrate_triangles


@full_precision
def project_mesh(
    vertices: Tensor, faces: Tensor, projection_matrices: Tensor, det_shape: tuple[int, int], *, backend: str = "auto"
) -> Tensor:
    """Path lengths in mm through a closed mesh, `(..., V, rows, cols)`, averaged over each pixel.

    A ray's chord is the sum over all triangles it hits of the distance from the source, negative where the ray enters
    and positive where it leaves. In detector coordinates this distance is `|M^-1 (u, v, 1)| / w`, with w = 1 / depth
    affine over a projected triangle. Each projected triangle is clipped to each pixel's square (Sutherland and Hodgman
    1974) and 1 / w is integrated over the clipped polygon, to fourth order in its variation there; `|M^-1 (u, v, 1)|`
    is taken at the pixel's centre. Only the parts of triangles on the detector count. Computed in float64.

    The result is differentiable in the vertices and the matrices, including moving silhouettes, which chords
    through pixel centres alone would miss.

    Args:
        vertices: Vertices in mm, `(..., n, 3)`.
        faces: Vertex indices `(m, 3)` of a closed mesh, counter-clockwise seen from outside (otherwise
            lengths are negative). An open mesh gives errors of the order of the depth.
        projection_matrices: `(V, 3, 4)`, world mm to homogeneous pixels, the last row giving the depth in mm.
        det_shape: Rows and columns of the detector.
        backend: "auto", "cpp" or "torch".

    Raises:
        ValueError: A shape or an index is wrong, or a vertex is not in front of the source.

    >>> import trimesh
    >>> box = trimesh.creation.box((10.0, 20.0, 30.0))
    >>> P = torch.tensor([[[1000.0, 0, 15, 7500], [0, 1000, 15, 7500], [0, 0, 1, 500]]])
    >>> chord = project_mesh(torch.tensor(box.vertices), torch.tensor(box.faces), P, (31, 31))
    >>> round(float(chord[0, 15, 15]), 2)
    30.0
    """
    _check_arguments(vertices, faces, projection_matrices, det_shape)
    dtype = vertices.dtype if vertices.dtype.is_floating_point else torch.get_default_dtype()
    faces = faces.to(vertices.device, torch.long)
    matrices = projection_matrices.to(vertices.device, torch.float64)
    shapes = vertices.reshape(-1, 1, *vertices.shape[-2:]).to(torch.float64)
    homogeneous = shapes @ matrices[:, :, :3].mT + matrices[:, None, :, 3]
    depth = homogeneous[..., 2:]
    if bool((depth <= 0).any()):
        raise ValueError(f"vertices must lie in front of the source, got a depth of {float(depth.min()):g} mm")
    # u, v shifted so that pixel (row, col) is the square [col, col + 1] x [row, row + 1]
    projected = torch.cat([homogeneous[..., :2] / depth + 0.5, 1 / depth], dim=-1)
    images = _signed_depths(projected.flatten(0, 1), faces, det_shape, backend).reshape(
        *projected.shape[:2], *det_shape
    )
    lengths = images * torch.stack([_distance_per_depth(matrix, det_shape) for matrix in matrices])
    return lengths.reshape(*vertices.shape[:-2], len(matrices), *det_shape).to(dtype)


def _signed_depths(projected: Tensor, faces: Tensor, det_shape: tuple[int, int], backend: str) -> Tensor:
    """Integrals of the signed depths (B, rows, cols) for projected vertices (B, n, 3)."""
    if choose_backend(projected, backend, operator=MESH_LENGTHS.name).is_reference:
        return integrate_triangles(projected, faces, *det_shape)
    return differentiable(_MeshKernel(faces, det_shape), projected)


class _MeshKernel:
    """Kernel for one mesh and detector, differentiable by `torchkcreg.kernels.differentiable`."""

    def __init__(self, faces: Tensor, det_shape: tuple[int, int]) -> None:
        self._faces, self._det_shape = faces, det_shape

    def forward(self, projected: Tensor) -> Tensor:
        return MESH_LENGTHS.dispatched(projected, self._faces, *self._det_shape)

    def reference(self, projected: Tensor) -> Tensor:
        return integrate_triangles(projected, self._faces, *self._det_shape)

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> Sequence[Tensor | None]:
        return (MESH_LENGTHS_BACKWARD.dispatched(gradient.contiguous(), *inputs, self._faces),)


def _gradient(gradient: Tensor, projected: Tensor, faces: Tensor) -> Tensor:
    """Gradient with respect to the projected vertices, by autograd through the reference."""
    leaf = projected.detach().requires_grad_(True)
    with torch.enable_grad():
        images = integrate_triangles(leaf, faces, *gradient.shape[-2:])
    return torch.autograd.grad(images, leaf, gradient)[0]


def _distance_per_depth(matrix: Tensor, det_shape: tuple[int, int]) -> Tensor:
    """Ratio of distance from the source to depth at each pixel centre, signed by the handedness of the axes."""
    rows, cols = (torch.arange(size, dtype=matrix.dtype, device=matrix.device) for size in det_shape)
    inverse = torch.linalg.inv(matrix[:, :3])
    rays = inverse[:, 0] * cols[None, :, None] + inverse[:, 1] * rows[:, None, None] + inverse[:, 2]
    return rays.norm(dim=-1) * torch.linalg.det(matrix[:, :3]).sign()


def _check_arguments(vertices: Tensor, faces: Tensor, projection_matrices: Tensor, det_shape: tuple[int, int]) -> None:
    """Raise ValueError if shapes or indices do not fit."""
    if vertices.dim() < 2 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices must have shape (..., n, 3), got {tuple(vertices.shape)}")
    if faces.dim() != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape (m, 3), got {tuple(faces.shape)}")
    if faces.numel() and not (int(faces.min()) >= 0 and int(faces.max()) < vertices.shape[-2]):
        raise ValueError(
            f"faces must index {vertices.shape[-2]} vertices, got {int(faces.min())} to {int(faces.max())}"
        )
    if projection_matrices.dim() != 3 or projection_matrices.shape[1:] != (3, 4):
        raise ValueError(f"projection_matrices must have shape (V, 3, 4), got {tuple(projection_matrices.shape)}")
    if len(det_shape) != 2 or min(det_shape) < 1:
        raise ValueError(f"det_shape must be two positive numbers, got {tuple(det_shape)}")


# projected (B, n, 3), faces (m, 3) -> (B, rows, cols)
MESH_LENGTHS = Operator(
    "mesh_lengths(Tensor projected, Tensor faces, int rows, int cols) -> Tensor",
    reference=integrate_triangles,
    fake=lambda projected, faces, rows, cols: projected.new_empty(len(projected), rows, cols),
)
MESH_LENGTHS_BACKWARD = Operator(
    "mesh_lengths_backward(Tensor gradient, Tensor projected, Tensor faces) -> Tensor",
    reference=_gradient,
    fake=lambda gradient, projected, faces: torch.empty_like(projected),
)

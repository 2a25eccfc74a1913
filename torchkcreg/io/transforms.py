"""Export of a registered deformation: ITK transform and displacement field."""

from __future__ import annotations

import copy
import math
import os

import SimpleITK as sitk
import torch
from torch import Tensor

from torchkcreg.deformation import Deformation, SplineField
from torchkcreg.geometry import transform_points

from .files import atomic_path

_DVF_BLOCK = 65536


def itk_transform(implant_to_world: Tensor, deformation: SplineField) -> sitk.CompositeTransform:
    """ITK transform that maps points from the implant's frame to the world: T(x) = implant_to_world(x + u(x)).

    A composite of a cubic `BSplineTransform` on the control-point grid (applied first) and an `AffineTransform` with
    the rigid pose. Inside the grid's valid domain (control points 1 to n - 2 of each axis) `TransformPoint` agrees with
    `warp` up to rounding. Outside it, the displacement of ITK's B-spline is zero, whereas `warp` continues with the
    motion of the nearest group of control points. Coordinates are ITK's physical ones (LPS in 3D Slicer). As always in
    ITK, the transform maps points from the space of the *output* image: resampling a world image with it gives the
    image in the implant's frame.

    Args:
        implant_to_world: Rigid transform (4, 4).
        deformation: Displacements of the control points.
    """
    spline = sitk.BSplineTransform(3, 3)
    grid = deformation.grid
    shape, spacing = [int(n) for n in grid.shape], [float(s) for s in grid.spacing]
    frame = torch.as_tensor(grid.frame).detach().cpu().double()
    axes = frame[:3, :3]
    corner = transform_points(frame, torch.tensor([spacing], dtype=torch.float64))[0]  # control point (1, 1, 1)
    spline.SetTransformDomainOrigin(corner.tolist())
    spline.SetTransformDomainDirection(axes.flatten().tolist())
    spline.SetTransformDomainMeshSize([n - 3 for n in shape])
    spline.SetTransformDomainPhysicalDimensions([(n - 3) * s for n, s in zip(shape, spacing)])
    in_implant_axes = deformation.control_points.detach().cpu().double() @ axes.mT
    spline.SetParameters(in_implant_axes.permute(3, 2, 1, 0).flatten().tolist())  # component by component, x fastest

    pose = implant_to_world.detach().cpu().double()
    rigid = sitk.AffineTransform(3)
    rigid.SetMatrix(pose[:3, :3].flatten().tolist())
    rigid.SetTranslation(pose[:3, 3].tolist())
    return sitk.CompositeTransform([rigid, spline])  # ITK applies the last one first


def write_itk_transform(path: str | os.PathLike[str], implant_to_world: Tensor, deformation: SplineField) -> None:
    """Write `itk_transform` as a .tfm file for SimpleITK, ITK and 3D Slicer."""
    with atomic_path(path) as temporary:
        sitk.WriteTransform(itk_transform(implant_to_world, deformation), str(temporary))


def displacement_field(
    implant_to_world: Tensor,
    deformation: Deformation,
    points: Tensor,
    *,
    spacing_mm: float = 2.0,
    margin_mm: float = 15.0,
) -> sitk.Image:
    """Displacement field T(x) - x as a vector image over the implant's frame, mm.

    For a spline, the image is aligned with the control-point grid and covers its valid domain plus a margin. For other
    models, it is aligned with the axes of the implant's frame and covers the implant plus a margin.

    Voxel positions x are in the implant's frame, and T(x) = x + field(x) is in the world. If the implant was modelled
    in place (implant frame = world), the field is its motion. If it comes from a CAD frame, the field includes the
    change of frame. Every voxel has the value of `warp`, also outside the valid domain.

    Args:
        implant_to_world: Rigid transform (4, 4).
        deformation: Deformation of any model.
        points: Nodes (N, 3) of the implant.
        spacing_mm: Largest voxel size.
        margin_mm: Margin around the valid domain or the implant.

    Returns:
        Image of float32 vectors. Its indices run along the axes of the grid.
    """
    frame, low, high = _domain(deformation, points)
    starts, steps, counts = [], [], []
    for first, last in zip(low, high, strict=True):
        length = last - first + 2 * margin_mm
        count = max(2, math.ceil(length / spacing_mm) + 1)
        starts.append(first - margin_mm)
        steps.append(length / (count - 1))
        counts.append(count)
    x, y, z = (
        start + step * torch.arange(count, dtype=torch.float64) for start, step, count in zip(starts, steps, counts)
    )
    in_grid = torch.stack(torch.meshgrid(z, y, x, indexing="ij"), dim=-1).flip(-1).reshape(-1, 3)
    voxels = transform_points(frame, in_grid)
    vectors = warp(implant_to_world, deformation, voxels) - voxels
    image = sitk.GetImageFromArray(vectors.float().reshape(*reversed(counts), 3).numpy(), isVector=True)
    image.SetOrigin(transform_points(frame, torch.tensor([starts], dtype=torch.float64))[0].tolist())
    image.SetSpacing(steps)
    image.SetDirection(frame[:3, :3].flatten().tolist())
    return image


def _domain(deformation: Deformation, points: Tensor) -> tuple[Tensor, list[float], list[float]]:
    """Domain of the deformation: frame (4, 4) of a box and its lowest and highest corner in that frame."""
    if isinstance(deformation, SplineField):
        grid = deformation.grid
        ends = [(n - 2) * s for n, s in zip(grid.shape, grid.spacing, strict=True)]
        return torch.as_tensor(grid.frame).detach().cpu().double(), list(grid.spacing), ends
    nodes = points.detach().cpu().double()
    return torch.eye(4, dtype=torch.float64), nodes.amin(0).tolist(), nodes.amax(0).tolist()


def write_displacement_field(
    path: str | os.PathLike[str], implant_to_world: Tensor, deformation: Deformation, points: Tensor
) -> None:
    """Write `displacement_field` as a compressed image (.mha, .nrrd)."""
    with atomic_path(path) as temporary:
        sitk.WriteImage(displacement_field(implant_to_world, deformation, points), str(temporary), useCompression=True)


@torch.no_grad()
def warp(implant_to_world: Tensor, deformation: Deformation, points: Tensor) -> Tensor:
    """World positions (N, 3) float64 of points (N, 3) of the implant's frame: implant_to_world(x + u(x))."""
    exact = copy.deepcopy(deformation).cpu().double()
    blocks = points.detach().cpu().double().split(_DVF_BLOCK)
    return torch.cat([transform_points(implant_to_world.detach().cpu().double(), exact(block)) for block in blocks])

"""Volumes with their voxel grid: MHA, NRRD, NIfTI."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

from .files import atomic_path, existing_file
from .scans import read_image

VOLUME_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nii", ".nii.gz")


def write_volume(path: str | os.PathLike[str], volume: Tensor, grid: VolumeGrid) -> None:
    """Write a volume (D, H, W) with its grid atomically, in the format of the suffix.

    Positions are ITK's physical ones (LPS), so 3D Slicer and SimpleITK place the voxels as `grid` does. Integer volumes
    keep their type, all others become float32.

    Raises:
        ValueError: The shapes differ, or the suffix is none of .mha, .nrrd, .nii, .nii.gz.
    """
    if tuple(volume.shape) != tuple(grid.shape):
        raise ValueError(f"volume must have the grid's shape {tuple(grid.shape)}, got {tuple(volume.shape)}")
    if not Path(path).name.lower().endswith(VOLUME_SUFFIXES) or Path(path).suffix == ".mhd":
        raise ValueError(f"volumes are written as .mha, .nrrd, .nii or .nii.gz, got {path}")
    values = volume.detach().cpu()
    image = sitk.GetImageFromArray((values.float() if values.is_floating_point() else values).numpy())
    image.SetSpacing(grid.spacing)
    image.SetOrigin(grid.origin)
    image.SetDirection(np.asarray(grid.direction).flatten().tolist())
    with atomic_path(path) as temporary:
        sitk.WriteImage(image, str(temporary), useCompression=True)


def read_volume(path: str | os.PathLike[str]) -> tuple[Tensor, VolumeGrid]:
    """A volume (D, H, W), float32 or float64, and its grid, from .mha, .mhd, .nrrd, .nii or .nii.gz.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, or is not a scalar volume of three dimensions.
    """
    path = existing_file(path, "volume")
    if not path.name.lower().endswith(VOLUME_SUFFIXES):
        raise ValueError(f"volume file {path} must be one of {', '.join(VOLUME_SUFFIXES)}")
    try:
        image = read_image(path)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1:] or ["unknown"]
        raise ValueError(f"volume file {path} cannot be read: {reason[0]}") from error
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise ValueError(f"volume file {path} must hold a scalar volume of three dimensions")
    array = sitk.GetArrayFromImage(image)
    dtype = np.float64 if array.dtype == np.float64 else np.float32
    direction = np.asarray(image.GetDirection()).reshape(3, 3)
    left, _, right = np.linalg.svd(direction)  # NIfTI stores float32 quaternions: make the matrix orthonormal again
    grid = VolumeGrid(array.shape, image.GetSpacing(), image.GetOrigin(), tuple(map(tuple, left @ right)))
    return torch.from_numpy(np.ascontiguousarray(array, dtype=dtype)), grid

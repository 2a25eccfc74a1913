"""Camera calibrations of XMALab: MayaCam 2.0 text files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchkcreg.geometry import ConeBeamGeometry

from .files import write_text

_BLOCKS = {"image size": (1, 2), "camera matrix": (3, 3), "rotation": (3, 3), "translation": (3, 1)}
_MAGNIFICATION = 1.3  # of what the cameras are aimed at, if nothing says how large a pixel is
_LONGEST_MM = 3000.0


def is_mayacam(path: Path) -> bool:
    """True if a text file starts as MayaCam 2.0 does."""
    if path.suffix.lower() != ".txt" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(64).strip().lower().startswith(b"image size")


def mayacam_files(folder: Path) -> list[Path]:
    """The MayaCam files of a folder, in the order of their names; one camera each."""
    return [path for path in sorted(folder.glob("*.txt")) if is_mayacam(path)]


def read_mayacam(
    paths: Sequence[Path], *, pixel_spacing: Sequence[float] | None = None, det_shape: Sequence[int] | None = None
) -> ConeBeamGeometry:
    """The geometry of calibrated cameras, a view each: pixel ~ K (R X + t), X in mm, rows downwards.

    Pixel coordinates count from the centre of the first pixel. The files do not say how large a pixel is. It does not
    change the rays, only lengths on the detector such as the blur's. Without `pixel_spacing` it is chosen so that
    the point that the cameras are aimed at is magnified 1.3 times.

    Args:
        paths: One file per camera.
        pixel_spacing: (dv, du), mm; None if unknown.
        det_shape: (rows, cols) that the images must have; None if unknown.

    Raises:
        ValueError: A file is no MayaCam 2.0 calibration, or the image sizes differ.
    """
    if not paths:
        raise ValueError("holds no MayaCam 2.0 calibration")
    cameras = [_camera(path) for path in paths]
    sizes = {tuple(int(edge) for edge in camera["image size"][0]) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"its cameras have images of different sizes: {sorted(sizes)}")
    cols, rows = sizes.pop()
    if det_shape is not None and tuple(det_shape) != (rows, cols):
        raise ValueError(f"its cameras have {rows} x {cols} pixels, the images {tuple(det_shape)}")
    matrices = torch.from_numpy(np.stack([_matrix(camera) for camera in cameras]))
    focal_px = float(np.mean([camera["camera matrix"][[0, 1], [0, 1]] for camera in cameras]))
    if pixel_spacing is None:
        depths = [float(np.linalg.norm(_source(camera))) for camera in cameras]
        spacing = min(_MAGNIFICATION * float(np.mean(depths)), _LONGEST_MM) / focal_px
        pixel_spacing = (spacing, spacing)
    return ConeBeamGeometry(matrices, (rows, cols), pixel_spacing, sources=[path.stem for path in paths])


def _camera(path: Path) -> dict[str, NDArray]:
    """Blocks of a file by their names."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    blocks = {}
    for name, shape in _BLOCKS.items():
        try:
            start = [line.lower() for line in lines].index(name) + 1
            numbers = [[float(x) for x in line.split(",")] for line in lines[start : start + shape[0]]]
            blocks[name] = np.array(numbers, dtype=np.float64)
        except ValueError:
            raise ValueError(f"{path.name} has no block {name!r} of numbers, as MayaCam 2.0 does") from None
        if blocks[name].shape != shape or not np.isfinite(blocks[name]).all():
            raise ValueError(f"{path.name}: {name!r} must be {shape[0]} x {shape[1]} numbers")
    rotation = blocks["rotation"]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(f"{path.name}: 'rotation' is no rotation")
    return blocks


def _matrix(camera: dict[str, NDArray]) -> NDArray:
    return camera["camera matrix"] @ np.hstack([camera["rotation"], camera["translation"]])


def _source(camera: dict[str, NDArray]) -> NDArray:
    """Position of the source (3,) in the calibration's world, whose origin is the calibration object."""
    return -(camera["rotation"].T @ camera["translation"])[:, 0]


def write_mayacam(folder: Path, geometry: ConeBeamGeometry) -> list[Path]:
    """Write a MayaCam 2.0 file per view into a folder, `camera_0.txt` and so on; return them.

    Raises:
        ValueError: A view's columns and rows are not perpendicular, so that it is no camera with square axes.
    """
    written = []
    rows, cols = geometry.det_shape
    for view, matrix in enumerate(geometry.projection_matrices.detach().cpu().double().numpy()):
        flipped = np.flip(np.eye(3), 0)
        orthogonal, triangular = np.linalg.qr((flipped @ matrix[:, :3]).T)
        camera, rotation = flipped @ triangular.T @ flipped, flipped @ orthogonal.T
        signs = np.sign(np.diag(camera))
        camera, rotation = camera * signs, signs[:, None] * rotation
        if np.linalg.det(rotation) < 0:
            raise ValueError(f"view {view} is mirrored: MayaCam's rows run downwards and its columns to the right")
        translation = np.linalg.solve(camera, matrix[:, 3])
        blocks = {
            "camera matrix": np.triu(camera / camera[2, 2]),
            "rotation": rotation,
            "translation": translation[:, None],
        }
        text = f"image size\n{cols},{rows}\n"
        for name, block in blocks.items():
            text += f"\n{name}\n" + "".join(",".join(f"{x:.12g}" for x in row) + "\n" for row in block)
        written.append(folder / f"camera_{view}.txt")
        write_text(written[-1], text)
    return written

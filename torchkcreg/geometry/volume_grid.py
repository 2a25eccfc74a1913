"""`VolumeGrid`: world positions of the voxels of a volume, and distances on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class VolumeGrid:
    """Voxel grid of a volume of shape (D, H, W), indexed z, y, x; lengths and positions are in x, y, z order.

    Voxel index (i, j, k), i along x, is at `origin + direction @ ((i, j, k) * spacing)` and holds
    `volume[k, j, i]`: the conventions of ITK.

    Attributes:
        shape: Number of voxels (D, H, W).
        spacing: Voxel spacing (x, y, z) in mm, positive; one number is used for all three.
        origin: World position (x, y, z) in mm of the centre of voxel (0, 0, 0).
        direction: 3 x 3 matrix whose columns are the unit vectors of the x, y and z index.

    Raises:
        ValueError: Counts or lengths are not positive, or the direction is not orthonormal.

    >>> grid = VolumeGrid.centered((4, 4, 8), spacing=0.5)
    >>> grid.origin
    (-1.75, -0.75, -0.75)
    >>> grid.points().shape
    torch.Size([4, 4, 8, 3])
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[tuple[float, float, float], ...] = _IDENTITY

    def __post_init__(self) -> None:
        shape = tuple(int(n) for n in self.shape)
        if len(shape) != 3 or any(n < 1 for n in shape):
            raise ValueError(f"shape must be three positive integers (D, H, W), got {self.shape}")
        spacing = _three("spacing", self.spacing)
        if any(d <= 0 for d in spacing):
            raise ValueError(f"spacing must be positive, got {self.spacing}")
        axes = torch.as_tensor(self.direction, dtype=torch.float64).cpu()
        if axes.shape != (3, 3) or not torch.allclose(axes @ axes.mT, torch.eye(3, dtype=torch.float64), atol=1e-5):
            raise ValueError(f"direction must be an orthonormal 3 x 3 matrix, got {self.direction}")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "origin", _three("origin", self.origin))
        object.__setattr__(self, "direction", tuple(tuple(row) for row in axes.tolist()))

    @classmethod
    def centered(
        cls,
        shape: Sequence[int],
        spacing: float | Sequence[float],
        *,
        center: Sequence[float] = (0.0, 0.0, 0.0),
        direction: Sequence[Sequence[float]] = _IDENTITY,
    ) -> VolumeGrid:
        """Grid centred at the world position `center` (x, y, z) in mm."""
        steps = torch.tensor(_three("spacing", spacing), dtype=torch.float64)
        counts = torch.tensor([float(n) for n in shape], dtype=torch.float64).flip(0)
        axes = torch.as_tensor(direction, dtype=torch.float64)
        origin = torch.tensor(_three("center", center), dtype=torch.float64) - axes @ ((counts - 1) / 2 * steps)
        return cls(tuple(shape), tuple(steps.tolist()), tuple(origin.tolist()), direction)  # type: ignore[arg-type]

    @property
    def num_voxels(self) -> int:
        """Number of voxels."""
        return math.prod(self.shape)

    @property
    def voxel_volume(self) -> float:
        """Volume of a voxel, mm^3."""
        return math.prod(self.spacing)

    @property
    def size_mm(self) -> tuple[float, float, float]:
        """Outer size (x, y, z) of the grid in mm, whole voxels included."""
        depth, height, width = self.shape
        return (width * self.spacing[0], height * self.spacing[1], depth * self.spacing[2])

    @property
    def voxel_to_world(self) -> Tensor:
        """Transform (4, 4), float64, of voxel indices (i, j, k) in x, y, z order to world mm."""
        matrix = torch.eye(4, dtype=torch.float64)
        spacing = torch.tensor(self.spacing, dtype=torch.float64)
        matrix[:3, :3] = torch.tensor(self.direction, dtype=torch.float64) * spacing
        matrix[:3, 3] = torch.tensor(self.origin, dtype=torch.float64)
        return matrix

    @property
    def world_to_voxel(self) -> Tensor:
        """Transform (4, 4), float64, of world mm to voxel indices in x, y, z order."""
        return torch.linalg.inv(self.voxel_to_world)

    def lies_on(self, other: VolumeGrid) -> bool:
        """True if voxel positions agree with another grid's to a thousandth of a voxel."""
        return torch.allclose(self.voxel_to_world, other.voxel_to_world, atol=1e-3 * min(other.spacing))

    def points(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None) -> Tensor:
        """World positions (D, H, W, 3) in mm of the voxel centres."""
        matrix = self.voxel_to_world.to(device)
        axes = [torch.arange(n, dtype=torch.float64, device=device)[:, None] for n in self.shape]
        along_z, along_y, along_x = (axes[i] * matrix[:3, 2 - i] for i in range(3))
        positions = along_z[:, None, None] + along_y[:, None] + (along_x + matrix[:3, 3])
        return positions.to(dtype)


def _three(name: str, values: float | Sequence[float]) -> tuple[float, float, float]:
    flat = torch.as_tensor(values, dtype=torch.float64).flatten().tolist()
    flat = flat * 3 if len(flat) == 1 else flat
    if len(flat) != 3 or not all(math.isfinite(value) for value in flat):
        raise ValueError(f"{name} must be three finite numbers in x, y, z order, got {values}")
    return (flat[0], flat[1], flat[2])


def distance_to(filled: Tensor, grid: VolumeGrid) -> Tensor:
    """Distances (D, H, W) in mm of voxel centres from the nearest filled voxel; infinite if there is none.

    Args:
        filled: True or above zero inside the object, (D, H, W).
        grid: Grid of the voxels.
    """
    if not bool((filled > 0).any()):
        return torch.full(grid.shape, torch.inf)
    distances = distance_transform_edt((filled <= 0).cpu().numpy(), sampling=tuple(reversed(grid.spacing)))
    return torch.from_numpy(distances).float()
